"""Every CUDA kernel, forward and backward, on small cases: what compute-sanitizer looks at."""

import torch

from benchmarks.scene import camera, gaussians, model
from gsbench.kernels.adam import adam_all, flag_arrays
from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.raster import RasterInputs, Viewport, add_density, enqueue
from gsbench.models import CameraTime
from gsbench.models.gaussian_batch import tensors_of
from gsbench.raster import EPS2D, FAR, NEAR, rasterize

VIEWPORT = Viewport(70, 50, NEAR, FAR, EPS2D, antialias=False)
MODELS = (("3dgs", {}), ("4dgs", {}), ("6dgs", {}), ("7dgs", {}), ("7dgs", {"factor_order": "paper"}))


def main() -> None:
    viewmats, Ks = (x.repeat(2, 1, 1).cuda() for x in camera(70))  # two cameras
    for D in (3, 5):  # channels: blended at once, and in two turns
        means, factors, opacities, _ = (x.cuda().requires_grad_() for x in gaussians(1_000))
        colors = torch.rand(1_000, D, device="cuda").requires_grad_()
        arguments = means, factors * 4, opacities, colors, viewmats.requires_grad_(), Ks
        of_each = [torch.stack([x, x]) for x in arguments[:4]]  # the Gaussians of each camera
        for drawn in (arguments, (*of_each, *arguments[4:])):
            output = rasterize(*drawn, 70, 50, backend="cuda")
            (output.image.square().sum() + output.alpha.sum()).backward(retain_graph=True)
        for room in (100, 100_000):  # too few pairs, too many
            with torch.no_grad():
                enqueue(RasterInputs(*arguments[:3], colors[None], *arguments[4:], colors.new_zeros(D)), VIEWPORT, room)
    center = torch.tensor([0.0, 0.0, -4.0], device="cuda")
    for name, options in MODELS:
        batch = model(name, 500, agr=True, **options).cuda().slice(CameraTime.at(center, 0.4))
        sum(x.square().sum() for x in tensors_of(batch)).backward()
    images = torch.rand(2, 37, 50, 3, device="cuda").requires_grad_()
    l1_ssim(images, torch.rand(2, 37, 50, 3, device="cuda"), 0.2).sum().backward()
    arrays = [[x, y] for x, y in zip(*(torch.rand(4, 300, 7, device="cuda").unbind() for _ in range(2)), strict=True)]
    (*steps, skip), rates = torch.zeros(3, device="cuda"), torch.full((2,), 0.1, device="cuda")
    flag_arrays([*arrays[1], skip / skip], torch.zeros(3, device="cuda"), skip)
    drawn = [torch.rand(300, device="cuda") < 0.5, None]
    adam_all(*arrays, steps, [*rates], [0.9, 0.999], 1e-15, 1 - skip, drawn)
    counts = torch.zeros(2, 300, device="cuda").unbind()
    add_density(drawn[0][None], arrays[0][0][None, :, :2], (1.0, 1.0), *counts, counts[0].int())
    torch.cuda.synchronize()
    print("every kernel ran")


if __name__ == "__main__":
    main()
