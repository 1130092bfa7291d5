"""Every CUDA kernel once, forward and backward, on small cases: what compute-sanitizer looks at."""

import torch

from benchmarks.scene import camera, gaussians, model
from gsbench.kernels.loss import l1_ssim
from gsbench.raster import rasterize


def main() -> None:
    viewmats, Ks = (x.cuda() for x in camera(70))
    for D in (3, 5):  # blended at once, and in two turns
        means, factors, opacities, _ = (x.cuda().requires_grad_() for x in gaussians(2_000))
        colors = torch.rand(2_000, D, device="cuda").requires_grad_()
        output = rasterize(means, factors * 4, opacities, colors, viewmats.requires_grad_(), Ks, 70, 50, backend="cuda")
        (output.image.square().sum() + output.alpha.sum()).backward()
    for name in ("6dgs", "7dgs"):
        fitted = model(name, 500, agr=True).cuda()
        seen = fitted.slice(torch.tensor([0.0, 0.0, -4.0], device="cuda"), 0.4)
        sum(x.square().sum() for x in seen).backward()
    image = torch.rand(37, 50, 3, device="cuda").requires_grad_()
    l1_ssim(image, torch.rand(37, 50, 3, device="cuda"), 0.2).backward()
    torch.cuda.synchronize()


if __name__ == "__main__":
    main()
