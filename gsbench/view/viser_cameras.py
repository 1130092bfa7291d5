"""Convert cameras between gsbench's matrices and viser's position, quaternion and vertical field of view."""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from viser import transforms

from gsbench.scenes import Camera

Vector = NDArray[np.floating]


class ViserPose(NamedTuple):
    """The pose and the field of view of a camera in viser."""

    position: Vector  # [3] world units
    wxyz: Vector  # [4] quaternion of the rotation from camera axes (OpenCV's) to world axes
    fov: float  # vertical field of view, radians

    @classmethod
    def of(cls, camera: Camera) -> "ViserPose":
        """Return the pose of a camera, and the field of view that its focal length gives."""
        to_world = transforms.SO3.from_matrix(camera.viewmat[:3, :3].T.double().numpy())
        fov = 2 * math.atan(camera.height / 2 / float(camera.K[1, 1]))
        return cls(camera.center.double().numpy(), to_world.wxyz, fov)

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera for an image of the given size, pixels."""
        rotation = transforms.SO3(self.wxyz / np.linalg.norm(self.wxyz))
        to_world = transforms.SE3.from_rotation_and_translation(rotation, self.position)
        focal = height / 2 / math.tan(self.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(torch.from_numpy(to_world.inverse().as_matrix()).float(), K, width, height)
