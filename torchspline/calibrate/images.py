"""All corners that an image shows, as one measurement of the pose of its camera.

With a global shutter the corners of an image, hundreds of them, are seen from one pose. How they move is known once
it is known how the camera moves: residuals and their Jacobians by a body tangent of the camera and by its intrinsics
are summed over the corners first, robust weights included, and only what remains, a triangular factor of six (or
fourteen) rows, goes on to the control points, the extrinsics and the clock.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion, sighted
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.so3 import rotate
from torchspline.arithmetic.vector import Vector, cross, negate
from torchspline.fit.losses import Loss
from torchspline.fit.residual import POSE_IN_BODY, Argument, Clock, Cotangents, Given, Moment, Residual, Slot
from torchspline.fit.residuals.reprojection import ReprojectionEquidistant, ReprojectionRadtan
from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.terms import Differential, Kernel, Places, Term
from torchspline.fit.variables import Variable
from torchspline.groups import SE3
from torchspline.groups.components import join, split
from torchspline.kernels import emit
from torchspline.kernels.build import compiled
from torchspline.kernels.emit import Access
from torchspline.kernels.gram import triangles
from torchspline.kernels.threads import run
from torchspline.kernels.trace import trace

Array = NDArray[Any]
#: Where a landmark appears, by the name of the distortion.
PROJECTIONS: dict[str, type[Residual]] = {
    "radtan": ReprojectionRadtan,
    "equidistant": ReprojectionEquidistant,
}
#: Corners whose rows are made at a time: they stay in the cache.
_CHUNK = 4096
_POSE, _INTRINSICS = 6, 8
_TOGETHER = (
    "ImageBlock: the corners of an image are evaluated together, by fit.Problem; use ReprojectionRadtan or "
    "ReprojectionEquidistant elsewhere"
)


@dataclass
class _ImageKernel:
    """See `fit.solving.terms.Kernel`."""

    order: list[str]
    rows: int
    parts: list[tuple[bool, ...]]


class _ImageTerm(Term):
    """An `ImageBlock` bound to the unknowns of a problem: one measurement an image."""

    residual: "ImageBlock"

    def __init__(self, residual: "ImageBlock", model: Model, origin: float | int, index: dict[str, Array]):
        super().__init__(residual, model, origin, index)
        place = np.empty(len(self.order), np.int64)
        place[self.order] = np.arange(len(self.order))
        image = place[residual.image.numpy()]
        #: Corners image by image, in order of time.
        self.corners = np.argsort(image, kind="stable")
        self.image = np.ascontiguousarray(image[self.corners])
        self.xyz = np.ascontiguousarray(residual.xyz.numpy()[self.corners])
        self.uv = np.ascontiguousarray(residual.uv.numpy()[self.corners])
        self.first = np.searchsorted(self.image, np.arange(len(self.order) + 1)).astype(np.int64)

    def _kernel(self, given: tuple[tuple[str, bool], ...]) -> Kernel:
        intrinsics = self.residual.arguments["intrinsics"]
        free = isinstance(intrinsics, Variable) and id(intrinsics) in self.model.columns
        return _ImageKernel([slot for slot, _ in given], _POSE + (_INTRINSICS if free else 0), [(True,)])

    @property
    def numbers(self) -> int:
        return 2 * len(self.corners)

    def residuals(self, state: State) -> Array:
        """Pixels (C, 2), in the order of the corners."""
        places, local = self.places(state), state.local
        assert local is not None
        (value,) = self.model.trajectory.local.evaluate(local, places.base[0], places.u[0], 0)
        numbers = self._numbers(state, value)
        seen = self._rows(numbers, 0, len(self.corners), False)[:, :, -1]
        result = np.empty_like(seen)
        result[self.corners] = seen
        return result

    def _numbers(self, state: State, value: Array) -> tuple[Array, Array, Array]:
        """Poses of the cameras in the world, extrinsics, intrinsics."""
        arguments = {
            slot: state.values[id(x)] if isinstance(x, Variable) else x.detach().cpu().double()
            for slot, x in self.residual.arguments.items()
            if not hasattr(x, "control_points")
        }
        T = SE3.normalize(arguments.get("T_body_camera", SE3.identity()), validate=False)
        # Groups of rigid motions store position and rotation alike.
        cameras = SE3.compose(torch.from_numpy(value), T, validate=False)
        return cameras.numpy(), T.numpy(), np.ascontiguousarray(arguments["intrinsics"].numpy())

    def _rows(self, numbers: tuple[Array, Array, Array], begin: int, stop: int, free: bool) -> Array:
        """Residuals of corners and their Jacobians `(C, 2, 6 [+ 8] + 1)`."""
        kind, columns = self.residual.projection, _POSE + _INTRINSICS * free + 1
        cameras, _, intrinsics = numbers
        if self.model.trajectory.local.fused:
            rows = np.empty((stop - begin, 2, columns))
            _compiled(kind, free)(
                self.image[begin:stop], cameras.reshape(-1), self.xyz[begin:stop].reshape(-1),
                self.uv[begin:stop].reshape(-1), intrinsics, rows.reshape(-1), 0, stop - begin,
            )  # fmt: skip
            return rows
        arrays = cameras[self.image[begin:stop]], self.xyz[begin:stop], self.uv[begin:stop], intrinsics
        tensors = [torch.from_numpy(x) for x in arrays]
        flat = join(tuple(_corner(kind, free, *map(split, tensors))), tensors[0][:, :0])
        return flat.numpy().reshape(-1, 2, columns)

    def _differentiate(
        self, state: State, places: Places, part: slice, states: list[list[Array]]
    ) -> Differential:
        fused, free = self.model.trajectory.local.fused, self.kernel.rows > _POSE
        value = states[0][0]
        # Only the poses of this chunk are known; others are not looked at.
        numbers = self._numbers(state, value)
        offset, count = part.start, part.stop - part.start
        images, rows_of = len(value), self.kernel.rows
        blocks, costs = np.empty((images, rows_of, rows_of + 1)), np.empty(images)
        inside = ~places.outside[part]
        shifted = (
            np.concatenate([np.zeros((offset, 7)), numbers[0]]) if offset else numbers[0],
            *numbers[1:],
        )

        def piece(begin: int, stop: int) -> None:
            a, b = self.first[offset + begin], self.first[offset + stop]
            rows = self._rows(shifted, a, b, free)
            starts = self.first[offset + begin : offset + stop + 1] - a
            rho, slope = self._weighted(rows, starts)
            sums = np.concatenate([[0.0], np.cumsum(rho)])
            costs[begin:stop] = 0.5 * (sums[starts[1:]] - sums[starts[:-1]]) * inside[begin:stop]
            slope = slope * np.repeat(inside[begin:stop], np.diff(starts))
            blocks[begin:stop] = triangles(fused, rows, starts, slope)

        step = max(1, int(_CHUNK * images / max(self.first[part.stop] - self.first[part.start], 1)))
        run([partial(piece, i, min(i + step, count)) for i in range(0, count, step)])
        camera = blocks[:, :, :_POSE]
        T = torch.from_numpy(numbers[1])
        body = camera @ SE3.adjoint(SE3.inverse(T), validate=False).numpy()
        moment = self._cotangent(torch.from_numpy(value), torch.from_numpy(body)).numpy()
        by_slot = {"T_body_camera": camera, "intrinsics": blocks[:, :, _POSE:-1]}
        error = blocks[:, :, -1]
        return Differential(
            error, error, None, costs, [moment], [by_slot[slot] for slot in self.kernel.order]
        )

    def _weighted(self, rows: Array, starts: Array) -> tuple[Array, Array]:
        """Cost (twice) of every corner, and what its squares count in the normal equations."""
        information = 1.0 / self.residual.pixels**2
        squared = np.square(rows[:, :, -1]).sum(axis=1) * information
        loss = self.residual.loss
        if loss is None:
            return squared, np.full_like(squared, information)
        s = torch.from_numpy(squared)
        return loss.rho(s).numpy(), loss.weight(s).numpy() * information

    def _cotangent(self, value: Tensor, body: Tensor) -> Tensor:
        """From rows by the rigid body's own tangent to rows by that of the trajectory's group."""
        mechanics = MOTIONS[self.model.trajectory.name]
        point = split(value.unsqueeze(1))
        motion = mechanics.motion(point, ())
        g = split(body)
        back, _ = mechanics.reverse(point, (), motion, Motion(q=g[3:], p=rotate(motion.q, g[:3])))
        return join(back, body[..., :0])


class ImageBlock(Residual):
    """Corners of a known board in images of one camera with a global shutter, [S20] (67): one measurement an image.

    The same cost and normal equations as `ReprojectionRadtan` or `ReprojectionEquidistant` on each corner (which see
    for the model), at a small part of the time.

    Args:
        t: (N,) times of the images.
        image: (C,) int64, which image shows each corner. uv: (C, 2) where, px. xyz: (C, 3) the corner in the world, m.
        distortion: "radtan" or "equidistant".
        sigma: standard deviation of a coordinate, px. loss: of each corner.
        intrinsics: (8,), as the residuals above. T_body_camera: pose of the camera in the body, SE3.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    rows, measured_size, derivatives = 1, 0, 0
    slots: ClassVar[Mapping[str, Slot]] = {
        "intrinsics": Slot(8, None, None),
        "T_body_camera": POSE_IN_BODY,
    }
    term = _ImageTerm

    def __init__(
        self,
        t: Tensor,
        *,
        image: Tensor,
        uv: Tensor,
        xyz: Tensor,
        distortion: str = "radtan",
        sigma: float = 1.0,
        loss: Loss | None = None,
        clock: Clock | None = None,
        name: str | None = None,
        **arguments: Argument,
    ):
        checks.instance("t", t, Tensor, "the times of the images, a torch.Tensor")
        checks.choice("distortion", distortion, tuple(PROJECTIONS))
        for slot, x in arguments.items():
            if slot in self.slots and not isinstance(x, (Variable, Tensor)):
                raise TypeError(f"{slot}: expected a Variable or a tensor, got {type(x).__name__}")
            if slot in self.slots and isinstance(x, Tensor) and x.ndim != 1:
                raise ValueError(f"{slot}: expected one for all images, 1 dimension, got {tuple(x.shape)}")
        if clock is not None and isinstance(clock, Clock) and clock.delay is not None:
            raise ValueError(
                "clock: corners of a block are seen at once; got a line delay: use ReprojectionRadtan or "
                "ReprojectionEquidistant for a rolling shutter"
            )
        given: dict[str, Any] = {"loss": loss, "clock": clock, "name": name, **arguments}
        super().__init__(t, torch.empty(len(t), 0, dtype=torch.float64), **given)
        count = _check_corners(image, uv, xyz, len(t))
        self.image, self.uv, self.xyz = (x.detach().cpu() for x in (image, uv.double(), xyz.double()))
        self.pixels, self.projection = checks.positive("sigma", sigma), PROJECTIONS[distortion]
        self.count = count

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        raise NotImplementedError(_TOGETHER)

    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        raise NotImplementedError(_TOGETHER)

    def __repr__(self) -> str:
        return f"{self.name}({self.count} corners in {len(self)} images)"


def _check_corners(image: Tensor, uv: Tensor, xyz: Tensor, images: int) -> int:
    checks.instance("image", image, Tensor, "an int64 index, a torch.Tensor")
    if image.dtype != torch.int64 or image.ndim != 1:
        raise ValueError(f"image: expected shape (C,) int64, got {tuple(image.shape)} {image.dtype}")
    if len(image) and (int(image.min()) < 0 or int(image.max()) >= images):
        raise ValueError(
            f"image: expected indices from 0 to {images - 1}, got {int(image.min())} to {int(image.max())}"
        )
    for name, x, size in (("uv", uv, 2), ("xyz", xyz, 3)):
        checks.is_floating_tensor(name, x)
        if x.shape != (len(image), size):
            raise ValueError(f"{name}: expected shape ({len(image)}, {size}), got {tuple(x.shape)}")
        checks.finite(name, x)
    return len(image)


def _corner(
    kind: type[Residual], free: bool, camera: Vector, xyz: Vector, uv: Vector, intrinsics: Vector
) -> list[Scalar]:
    """Two rows `[J | r]` of a corner, by the camera's body tangent and, if `free`, its intrinsics."""
    still = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    residual = kind.__new__(kind)
    group = SE3.arithmetic
    seen = sighted(Motion(q=camera[3:], p=camera[:3]), still, xyz)
    # With the world's origin in the camera the pose is the identity: a landmark `seen`, and only it moves.
    at = [Moment(still, ())]
    given = {"intrinsics": intrinsics, "landmark": seen, "T_body_camera": still}
    error = residual.evaluate(group, at, given, uv)
    rows: list[Scalar] = []
    for r in range(2):
        unit = (1.0, 0.0) if r == 0 else (0.0, 1.0)
        _, cotangents = residual.reverse(group, at, given, uv, unit)
        g = cotangents["landmark"]
        # A body tangent (v, w) of the camera moves what it sees by seen x w - v.
        rows += [*negate(g), *cross(g, seen), *(cotangents["intrinsics"] if free else ()), error[r]]
    return rows


@cache
def _compiled(kind: type[Residual], free: bool) -> Callable:
    """`_corner` for many."""
    columns = _POSE + _INTRINSICS * free + 1
    name = f"corners_{kind.__name__}{'_intrinsics' if free else ''}"
    source = emit.emit_placed(
        name,
        trace(partial(_corner, kind, free), [7, 3, 2, 8], torch.float64),
        ["image", "cameras", "xyz", "uv", "intrinsics", "rows"],
        ["place = image[item]"],
        [Access("cameras", "place * 7", 7), Access("xyz", "item * 3", 3), Access("uv", "item * 2", 2)],
        [Access("intrinsics", "0", 8)],
        [Access("rows", f"item * {2 * columns}", 2 * columns)],
        torch.float64,
    )
    return compiled(name, source, f"(int64[::1], {', '.join(['float64[::1]'] * 5)}, int64, int64)")
