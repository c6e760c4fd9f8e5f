"""What simulated recordings tell: times, that all variants agree, and whether deviations are true."""

from time import perf_counter, process_time
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from calibration.variants import by_product_rule, by_recurrence, solve_automatically
from torchspline.calibrate.problem import Layout, Options, build
from torchspline.calibrate.simulate import Simulation, simulate
from torchspline.calibrate.start import Start
from torchspline.groups import SE3, SO3

#: [S20] Table 3, seconds: split ours analytic, ours and baseline by Ceres, joint ours and baseline by Ceres.
PAPER_TIMES = {
    ("split", "analytic"): 5.82,
    ("split", "automatic"): 14.18,
    ("split", "product rule"): 15.09,
    ("joint", "automatic"): 23.56,
    ("joint", "product rule"): 37.14,
}
#: [S20] Table 2, largest deviations from the mean of all methods, by the names below.
PAPER_DEVIATIONS = {
    "g": 6.07e-5, "b_a": 6.32e-5, "b_g": 2.14e-9, "t_ic0": 6.34e-6, "t_ic1": 6.33e-6, "R_ic0": 3.51e-8,
    "R_ic1": 3.34e-8,
}  # fmt: skip
VARIANTS = ("analytic", "automatic", "product rule")
#: Until nothing moves any more.
_TIGHT = {"cost": 1e-15, "gradient": 1e-9}


def near(made: Simulation, seed: int, position: float = 2e-3, rotation: float = 3e-3) -> Start:
    """A start as board poses give one: extrinsics some centimetres and degrees off, no biases, noisy poses."""
    g = torch.Generator().manual_seed(1000 + seed)

    def noise(count: int, metres: float, radians: float) -> Tensor:
        x = torch.randn(count, 6, generator=g, dtype=torch.float64)
        return x * torch.tensor([metres] * 3 + [radians] * 3, dtype=torch.float64)

    t = made.recording.corners[0].t_ns
    poses = SE3.retract(made.trajectory(t), noise(len(t), position, rotation), side="right")
    cameras = len(made.T_imu_cam)
    return Start(
        T_imu_cam=SE3.retract(made.T_imu_cam, noise(cameras, 0.02, 0.02), side="right"),
        time_offset=torch.zeros(cameras, dtype=torch.float64),
        T_imu0_imu=SE3.identity(dtype=torch.float64)[None],
        imu_time_offset=torch.zeros(1, dtype=torch.float64),
        gravity=made.gravity + 0.1 * noise(1, 1.0, 0.0)[0, :3],
        gyro_bias=torch.zeros(1, 3, dtype=torch.float64),
        accel_bias=torch.zeros(1, 3, dtype=torch.float64),
        t_ns=t,
        T_board_imu=poses,
        boards=(),
    )


def options(representation: str, order: int, spacing: float, single: bool = False) -> Options:
    """Plain least squares as in the paper. `single`: corners one by one, as automatic Jacobians need them."""
    estimate = {"time_offset", "line_delay"} if single else {"time_offset"}
    return Options(order, spacing, representation, frozenset(estimate), None, 0.5, None, None)


def solve(made: Simulation, start: Start, representation: str, order: int, spacing: float) -> dict[str, Any]:
    """From the recording and a start to the solution, analytic Jacobians."""
    begin, busy = perf_counter(), process_time()
    layout = build(made.recording, start, options(representation, order, spacing))
    built = perf_counter()
    result = layout.problem.solve(damping=1e-8)
    return {
        "seconds": perf_counter() - begin,
        "cpu": process_time() - busy,  # on a machine that others use, too
        "build": built - begin,
        "phases": result.seconds,
        "evaluations": result.evaluations,
        "cost": result.cost[-1],
        "layout": layout,
        "result": result,
    }


def full_size(
    size: dict[str, Any], representations: list[str], order: int, spacing: float, repeats: int, seed: int
) -> dict[str, Any]:
    """The recording of the paper's size, one thread; the fastest of several solutions, after one that compiles."""
    made = simulate(**size, order=order, spacing=spacing, seed=seed)
    start, found = near(made, seed), {}
    for representation in representations:
        runs = [solve(made, start, representation, order, spacing) for _ in range(repeats + 1)]
        best = min(runs, key=lambda run: run["seconds"])
        errors = deviations(estimates(best["layout"]), truth(made))
        found[representation] = {
            **{k: best[k] for k in ("seconds", "cpu", "build", "phases", "evaluations", "cost")},
            "errors": errors,
        }
        if representation == "split":
            layout, result = best["layout"], best["result"]
            found["sigmas"] = {
                name: result.standard_deviation(v).tolist()
                for name, v in layout.problem.variables.items()
                if "intrinsics" not in name
            }
        found.setdefault("estimates", {})[representation] = estimates(best["layout"])
    counts = {
        "corners": sum(map(len, made.recording.corners)),
        "images": sum(len(c.t_ns) for c in made.recording.corners),
        "samples": len(made.recording.imus[0]),
    }
    return {**found, **counts}


def variants(
    size: dict[str, Any], representations: list[str], order: int, spacing: float, seed: int
) -> tuple[dict[tuple[str, str], dict[str, Any]], dict[tuple[str, str], dict[str, Tensor]]]:
    """All of them on one recording: how long each took, and what it found."""
    made = simulate(**size, order=order, spacing=spacing, seed=seed)
    start, times, found = near(made, seed), {}, {}
    for representation in representations:
        for variant in VARIANTS:
            layout = build(
                made.recording, start, options(representation, order, spacing, variant != "analytic")
            )
            begin = perf_counter()
            if variant == "analytic":
                result = layout.problem.solve(cost_tolerance=1e-15, gradient_tolerance=1e-9)
                run = {"evaluations": result.evaluations, "cost": result.cost[-1]}
            else:
                for camera in layout.cameras:  # asked for only to have corners one by one
                    assert camera.line_delay is not None
                    layout.problem.freeze(camera.line_delay)
                states = by_recurrence if variant == "automatic" else by_product_rule
                run = solve_automatically(layout, states, **_TIGHT)
            times[representation, variant] = {**run, "seconds": perf_counter() - begin}
            found[representation, variant] = estimates(layout)
    return times, found


def estimates(layout: Layout) -> dict[str, Tensor]:
    """By the names of the paper's Table 2; gravity as the g of [S20] (70)."""
    values = {name: variable.value.clone() for name, variable in layout.problem.variables.items()}
    found = {"g": -values["gravity"], "b_a": values["imu0 accel bias"], "b_g": values["imu0 gyro bias"]}
    for i in range(len(layout.cameras)):
        T = values[f"cam{i} extrinsics"]
        found |= {f"t_ic{i}": T[:3], f"R_ic{i}": T[3:], f"offset{i}": -values[f"cam{i} ahead"]}
    return found


def truth(made: Simulation) -> dict[str, Tensor]:
    found = {"g": -made.gravity, "b_a": made.accel_bias, "b_g": made.gyro_bias}
    for i, T in enumerate(made.T_imu_cam):
        found |= {f"t_ic{i}": T[:3], f"R_ic{i}": T[3:], f"offset{i}": made.time_offset[i : i + 1]}
    return found


def deviations(a: dict[str, Tensor], b: dict[str, Tensor]) -> dict[str, float]:
    """Lengths of differences, angles of rotations."""
    result = {}
    for name, x in a.items():
        difference = SO3.log(SO3.between(b[name], x)) if name.startswith("R_") else x - b[name]
        result[name] = float(difference.norm())
    return result


def largest_from_mean(found: list[dict[str, Tensor]]) -> dict[str, float]:
    """As in [S20] Table 2."""
    mean = {}
    for name in found[0]:
        stacked = torch.stack([x[name] for x in found])
        if name.startswith("R_"):  # near enough for the arithmetic mean of quaternions of one sign
            signs = torch.sign((stacked * stacked[0]).sum(-1, keepdim=True))
            mean[name] = SO3.normalize((signs * stacked).mean(0))
        else:
            mean[name] = stacked.mean(0)
    each = [deviations(x, mean) for x in found]
    return {name: max(x[name] for x in each) for name in mean}


def consistency(
    size: dict[str, Any], draws: int, order: int, spacing: float, seed: int, share: float = 0.99
) -> dict[str, Any]:
    """Normalised estimation error squared of everything but the trajectory, over draws of noise; its interval.

    Once of all numbers together with their covariance, and once for each unknown.
    """
    together, apart = [], []
    for draw in range(draws):
        made = simulate(**size, order=order, spacing=spacing, seed=seed + draw)
        run = solve(made, near(made, seed + draw), "split", order, spacing)
        layout, result = run["layout"], run["result"]
        errors, columns = [], []
        for name, error in _errors(layout, made).items():
            variable = layout.problem.variables[name]
            errors.append(error.numpy())
            columns.append(result._linearizer.model.columns[id(variable)].reshape(-1))
            covariance = result.covariance(variable).numpy()
            apart.append((name, float(error.numpy() @ np.linalg.solve(covariance, error.numpy()))))
        e, c = np.concatenate(errors), np.concatenate(columns)
        i, j = np.broadcast_arrays(c[:, None], c[None, :])
        together.append(float(e @ np.linalg.solve(result._factor.inverse(i, j), e)))
    freedom = len(e)

    def interval(count: int) -> tuple[float, float]:
        low, high = chi2.ppf([(1 - share) / 2, (1 + share) / 2], draws * count) / draws
        return float(low), float(high)

    names = dict.fromkeys(name for name, _ in apart)
    sizes = {name: len(error) for name, error in _errors(layout, made).items()}
    return {
        "mean": float(np.mean(together)),
        "interval": interval(freedom),
        "freedom": freedom,
        "draws": draws,
        "each": {
            name: {
                "mean": float(np.mean([x for n, x in apart if n == name])),
                "interval": interval(sizes[name]),
                "freedom": sizes[name],
            }
            for name in names
        },
    }


def _errors(layout: Layout, made: Simulation) -> dict[str, Tensor]:
    """From the estimates to the truth, in the coordinates of a step."""
    variables = layout.problem.variables
    gravity = variables["gravity"]
    basis = gravity.basis(gravity.value)
    assert basis is not None
    fall = basis[0].T @ (made.gravity - gravity.value) / gravity.value.square().sum()
    found = {
        "gravity": fall,
        "imu0 gyro bias": made.gyro_bias - variables["imu0 gyro bias"].value,
        "imu0 accel bias": made.accel_bias - variables["imu0 accel bias"].value,
    }
    for i, T in enumerate(made.T_imu_cam):
        own = variables[f"cam{i} extrinsics"].value
        found[f"cam{i} extrinsics"] = SE3.log(SE3.between(own, T))
        found[f"cam{i} ahead"] = -made.time_offset[i : i + 1] - variables[f"cam{i} ahead"].value
    return found
