"""Group operations: this library, roma, PyPose and jaxlie."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bench import peers_jax, peers_pypose
from bench.contenders import deviation, without_radial
from bench.problems import UnavailableError, peer
from bench.timing import Task, prepared
from torchspline import Group, use_kernels


@dataclass(frozen=True)
class Operation:
    """`name` of `group` on `count` random arguments."""

    group: str
    name: str
    count: int = 1_000_000
    backward: bool = True
    dtype: str = "float64"
    threads: int = 1

    def arguments(self) -> list[Tensor]:
        generator, group = torch.Generator().manual_seed(0), Group(self.group)
        options = {"generator": generator, "dtype": getattr(torch, self.dtype)}
        if self.name == "exp":
            return [torch.randn(self.count, group.tangent_size, **options)]
        with use_kernels("reference"):
            return [group.random(self.count, **options) for _ in range(1 + (self.name == "compose"))]

    def cotangent(self) -> Tensor:
        group = Group(self.group)
        size = group.tangent_size if self.name == "log" else group.point_size
        generator = torch.Generator().manual_seed(1)
        return torch.randn(self.count, size, generator=generator, dtype=getattr(torch, self.dtype))


#: Those with a goal. More may follow: a name is a method of `torchspline.Group` and an entry at each peer.
OPERATIONS = tuple((group, name) for group in ("SO3", "SE3") for name in ("compose", "exp", "log"))

Function = Callable[..., Any]


def _task(
    operation: Operation,
    function: Function,
    arguments: Sequence[Tensor],
    cotangents: Sequence[Tensor],
    read: Callable[[Any], list[Any]] | None,
    kernels: str = "auto",
) -> Task:
    def call() -> Any:
        results = function(*arguments)
        if not operation.backward:
            return results
        return torch.autograd.grad(results, arguments, cotangents)

    for x in arguments:
        x.requires_grad_(operation.backward)
    return Task(call, operation.count, operation.threads, kernels, read)


def _arrays(tensors: Any, order: Sequence[int] | None = None) -> list[Any]:
    """Arrays in this library's layout: `order` for those that are points."""
    tensors = [tensors] if isinstance(tensors, Tensor) else tensors
    plain = (torch.Tensor.as_subclass(x.detach(), torch.Tensor) for x in tensors)
    return [(x if order is None else x[..., order]).double().numpy() for x in plain]


def ours(operation: Operation, kernels: str) -> Task:
    function = getattr(Group(operation.group), operation.name)
    return _task(operation, function, operation.arguments(), [operation.cotangent()], _arrays, kernels)


def fused(operation: Operation) -> Task:
    return ours(operation, "fused")


def reference(operation: Operation) -> Task:
    return ours(operation, "reference")


def roma(operation: Operation) -> Task:
    library, (to, back) = peer("roma"), (peers_pypose.TO_PYPOSE["SO3"], peers_pypose.FROM_PYPOSE["SO3"])
    x, g = operation.arguments(), operation.cotangent()
    if operation.group == "SO3":
        function = {
            "compose": library.quat_product,
            "exp": library.rotvec_to_unitquat,
            "log": library.unitquat_to_rotvec,
        }[operation.name]
        arguments = x if operation.name == "exp" else [a[..., to].contiguous() for a in x]
        cotangent = g if operation.name == "log" else g[..., to].contiguous()
        plain = operation.name == ("exp" if operation.backward else "log")  # what is read are tangents
        return _task(
            operation, function, arguments, [cotangent], lambda y: _arrays(y, None if plain else back)
        )
    if operation.name != "compose":
        raise UnavailableError("no exp or log of SE3")

    def compose(q: Tensor, t: Tensor, r: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        pose = library.RigidUnitQuat(q, t) @ library.RigidUnitQuat(r, s)
        return pose.linear, pose.translation

    def read(y: Any) -> list[Any]:
        pairs = zip(y[0::2], y[1::2], strict=True)
        return [np.concatenate([_arrays(t)[0], _arrays(q, back)[0]], axis=-1) for q, t in pairs]

    parts = [p.contiguous() for a in (*x, g) for p in (a[..., 3:][..., to], a[..., :3])]
    return _task(operation, compose, parts[:4], parts[4:], read)


def pypose(operation: Operation) -> Task:
    library = peer("pypose")
    to, back = peers_pypose.TO_PYPOSE[operation.group], peers_pypose.FROM_PYPOSE[operation.group]
    small, large = getattr(library, operation.group.lower()), getattr(library, operation.group)
    x, g = operation.arguments(), operation.cotangent()
    function = {"compose": lambda a, b: a * b, "exp": library.Exp, "log": library.Log}[operation.name]
    arguments = [small(a) if operation.name == "exp" else large(a[..., to].contiguous()) for a in x]
    cotangent = g if operation.name == "log" else g[..., to].contiguous()
    plain = operation.name == "log"
    # Its gradients are tangent vectors in the slots of the numbers: another convention, not compared.
    read = None if operation.backward else lambda y: _arrays(y, None if plain else back)
    return _task(operation, lambda *a: function(*a).tensor(), arguments, [cotangent], read)


def jaxlie(operation: Operation) -> Task:
    jax, library = peers_jax.start(), peer("jaxlie")
    if operation.threads != peers_jax.THREADS:
        raise UnavailableError(f"threads fixed at its start: {peers_jax.THREADS}")
    Lie = getattr(library, operation.group)
    to, back = peers_jax.TO_JAXLIE[operation.group], peers_jax.FROM_JAXLIE[operation.group]
    function = {
        "compose": lambda a, b: (Lie(a) @ Lie(b)).parameters(),
        "exp": lambda a: Lie.exp(a).parameters(),
        "log": lambda a: Lie(a).log(),
    }[operation.name]
    vectorised = jax.vmap(function)
    arguments = [
        jax.numpy.asarray(a.numpy() if operation.name == "exp" else a[..., to].numpy())
        for a in operation.arguments()
    ]
    g = operation.cotangent().numpy()
    cotangent = jax.numpy.asarray(g if operation.name == "log" else g[..., to])
    if operation.backward:
        compiled = jax.jit(lambda c, *a: jax.vjp(vectorised, *a)[1](c))
    else:
        compiled = jax.jit(lambda c, *a: (vectorised(*a),))
    plain = operation.name == ("exp" if operation.backward else "log")
    return Task(
        lambda: jax.block_until_ready(compiled(cotangent, *arguments)),
        operation.count,
        operation.threads,
        read=lambda y: [np.asarray(a) if plain else np.asarray(a)[..., back] for a in y],
    )


class Library(NamedTuple):
    name: str
    prepare: Callable[[Operation], Task]


#: A new contender is a function and a line here.
LIBRARIES = (
    Library("torchspline", fused),
    Library("torchspline, eager reference", reference),
    Library("roma", roma),
    Library("PyPose", pypose),
    Library("jaxlie, jit", jaxlie),
)


def deviations(operation: Operation, task: Task) -> float:
    """Largest deviation from the reference in float64, gradients less their components along quaternions."""
    assert task.read is not None
    wanted = replace(operation, dtype="float64")
    found, expected = task.read(task.run()), _arrays(reference(wanted).run())
    if operation.backward and operation.name != "exp":
        group = Group(operation.group)
        points = [x.numpy() for x in wanted.arguments()]
        found = [without_radial(g, x, group) for g, x in zip(found, points, strict=True)]
    return max(deviation(np.asarray(a, np.float64), b) for a, b in zip(found, expected, strict=True))


def verify(chosen: Sequence[tuple[str, str]], notes: set[str]) -> list[dict[str, Any]]:
    """How far results and gradients of all libraries are from the reference, on a few arguments."""
    rows = []
    for group, name in chosen:
        for backward in (False, True):
            operation = Operation(group, name, 10_000, backward)  # enough for this library to use its kernels
            what = f"{group} {name}" + (", gradient" if backward else "")
            for library, task in prepared(
                ((x.name, partial(x.prepare, operation)) for x in LIBRARIES), notes
            ):
                if task.read is not None:
                    found = deviations(operation, task)
                    rows.append({"contender": library, "what": what, "deviation": found})
    return rows
