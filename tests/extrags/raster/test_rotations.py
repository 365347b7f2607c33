from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from extrags.raster.rotations import rotation_matrices


def test_agree_with_scipy() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    torch.testing.assert_close(rotation_matrices(quats), torch.from_numpy(expected))


def test_the_null_quaternion_is_the_identity() -> None:
    torch.testing.assert_close(rotation_matrices(torch.zeros(1, 4))[0], torch.eye(3))
