"""What an imperfect triad makes of what it is exposed to: scale, misalignment, rotation, g-sensitivity; and back.

All of it is linear, so that one matrix does it, and its inverse undoes it.
"""

import torch
from torch import Tensor

from torchspline.groups.group import SO3


def lower_triangular(scale: Tensor, misalignment: Tensor | None) -> Tensor:
    """Kalibr's scale-misalignment matrix `[[sx, 0, 0], [myx, sy, 0], [mzx, mzy, sz]]`, (..., 3, 3).

    Args:
        scale: (..., 3) factors, one is perfect. misalignment: (..., 3) entries myx, mzx, mzy; None: zero.
    """
    matrix = torch.diag_embed(scale)
    if misalignment is None:
        return matrix
    below = matrix.new_zeros(3, 3, 3)
    for i, (row, column) in enumerate(((1, 0), (2, 0), (2, 1))):
        below[i, row, column] = 1.0
    return matrix + torch.einsum("...k,kij->...ij", misalignment, below)


def sensor_matrix(
    gyroscope: Tensor, accelerometer: Tensor, rotation: Tensor | None, g_sensitivity: Tensor | None
) -> Tensor:
    """From [angular rate, specific force] in the IMU's frame to noiseless, unbiased readings, (..., 6, 6).

    `gyroscope = M_g C w + S C f`, `accelerometer = M_a f`, as Kalibr's "scale-misalignment" models have it (there C
    is `C_gyro_i`, M_g and M_a the two `M`, S the `A` of the gyroscope).

    Args:
        gyroscope, accelerometer: M_g, M_a, (..., 3, 3). rotation: quaternion (..., 4), gyroscope to IMU frame, C^T.
        g_sensitivity: S (..., 3, 3), rad/s per m/s^2.
    """
    turn = None if rotation is None else SO3.to_matrix(rotation, validate=False).mT
    rate = gyroscope if turn is None else gyroscope @ turn
    if g_sensitivity is None:
        leak = torch.zeros_like(gyroscope)
    else:
        leak = g_sensitivity if turn is None else g_sensitivity @ turn
    batch = torch.broadcast_shapes(rate.shape, leak.shape, accelerometer.shape)[:-2]
    rate, leak, accelerometer = (x.expand(*batch, 3, 3) for x in (rate, leak, accelerometer))
    upper = torch.cat([rate, leak], dim=-1)
    return torch.cat([upper, torch.cat([torch.zeros_like(rate), accelerometer], dim=-1)], dim=-2)
