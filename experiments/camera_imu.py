"""Calibrates cameras against an IMU: a real recording, and simulated ones of the size of [S20] 6.2.

The real one is solved from nothing; reprojection errors stand beside those of independent poses of every image, and
parts of the recording beside each other. On simulated ones all variants of [S20] Tables 2 and 3 are solved: split and
joint splines, rates by recurrence and product rule, analytic and automatic Jacobians.
"""

from pathlib import Path
from typing import Any

import torch
from calibration import real, simulation
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure


def real_tables(figures: dict[str, Any]) -> list[Table]:
    seconds = figures["seconds"]
    time = Table(
        "Real recording, from nothing to the result, s",
        ("start", "build", "solve", "noise of sensors", "report", "total", "evaluations", "to reach, goal"),
        [(*(f"{seconds[x]:.2f}" for x in ("start", "build", "solve", "weights", "report", "total")),
          figures["evaluations"], "5, 3")],
    )  # fmt: skip
    error = Table(
        "Median reprojection error, px",
        ("intrinsics", "camera", "one pose an image", "calibration", "ratio"),
        [
            (name, f"cam{i}", f"{a:.3f}", f"{b:.3f}", f"{b / a:.3f}")
            for name, pair in figures["median_px"].items()
            for i, (a, b) in enumerate(zip(*pair.values(), strict=True))
        ],
    )
    pair = Table(
        "Camera to camera: each calibrated by itself against both together",
        ("intrinsics", "mm", "degrees", "to reach"),
        [
            (name, f"{x['mm']:.3f}", f"{x['degrees']:.4f}", "1 mm, 0.05")
            for name, x in figures["one_by_one"].items()
        ],
    )
    names = list(figures["halves"])
    halves = Table(
        "Halves of the recording: largest difference in its standard deviations (to reach: 3)",
        ("estimate", *names),
        [(key, *(f"{figures['halves'][n][key]:.2f}" for n in names)) for key in figures["halves"][names[0]]],
    )
    return [time, error, pair, halves]


def simulated_tables(
    full: dict[str, Any],
    times: dict[tuple[str, str], dict[str, Any]],
    table2: dict[str, float],
    same: dict[str, float],
    share: float,
) -> list[Table]:
    paper, sigmas = simulation.PAPER_DEVIATIONS, full["sigmas"]
    of = {"g": "gravity", "b_a": "imu0 accel bias", "b_g": "imu0 gyro bias"}
    of |= {f"{a}_ic{i}": f"cam{i} extrinsics" for a in "tR" for i in (0, 1)}

    def sigma(name: str) -> float:
        x = torch.tensor(sigmas[of[name]])
        x = x[:3] if name.startswith("t_") else x[3:] if name.startswith("R_") else x
        return float(x.norm()) * (9.80665 if name == "g" else 1.0)

    solved = list(full["estimates"].values())
    apart = simulation.deviations(solved[0], solved[-1])
    second = Table(
        f"[S20] Table 2: largest difference between the mean and the estimates of all six variants ({share:g} of the "
        "recording), of variants of one spline, and of split and joint on all of it",
        ("estimate", "paper", "six variants", "of one spline", "split, joint", "its deviation", "error of split"),
        [
            (name, f"{paper[name]:.2e}", f"{table2[name]:.2e}", f"{same[name]:.2e}", f"{apart[name]:.2e}",
             f"{sigma(name):.2e}", f"{full['split']['errors'][name]:.2e}")
            for name in paper
        ],
    )  # fmt: skip
    third = Table(
        "[S20] Table 3: seconds of a calibration, one thread",
        ("spline", "derivatives", "paper", "ours, full size", "its CPU time", f"ours, {share:g} of it", "evaluations"),
        [
            (spline, variant, simulation.PAPER_TIMES.get((spline, variant), "-"),
             f"{full[spline]['seconds']:.2f}" if variant == "analytic" else "-",
             f"{full[spline]['cpu']:.2f}" if variant == "analytic" else "-",
             f"{x['seconds']:.2f}", x["evaluations"])
            for (spline, variant), x in times.items()
        ],
    )  # fmt: skip
    return [second, third]


def consistency_table(found: dict[str, Any]) -> Table:
    def row(name: str, x: dict[str, Any]) -> tuple[str, ...]:
        low, high = x["interval"]
        return (
            name, str(x["freedom"]), f"{x['mean']:.3f}", f"{low:.3f} to {high:.3f}",
            "yes" if low <= x["mean"] <= high else "no",
        )  # fmt: skip

    rows = [row("all together", found), *(row(name, x) for name, x in found["each"].items())]
    title = f"Normalised estimation error squared, mean of {found['draws']} draws of noise"
    return Table(title, ("estimate", "freedom", "mean", "99 % interval", "inside"), rows)


def picture(out: Path, found: dict[str, Any]) -> None:
    figure = Figure(figsize=(7, 3.5))
    axes = figure.subplots()
    names = ["all together", *found["each"]]
    rows = [found, *found["each"].values()]
    for i, x in enumerate(rows):
        low, high = (y / x["freedom"] for y in x["interval"])
        axes.plot([i, i], [low, high], color="0.7", linewidth=8, solid_capstyle="butt")
        axes.plot(i, x["mean"] / x["freedom"], "o", color="C0")
    axes.axhline(1.0, color="k", linewidth=0.5)
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right")
    axes.set(
        ylabel="squared error / freedom", title="Estimation errors over their covariance, 99 % intervals"
    )
    save(figure, out / "consistency.png")


def experiment(
    out: Path,
    data: str,
    real_seconds: float | None,
    repeats: int,
    threads: int,
    order: int,
    spacing: float,
    representations: list[str],
    seconds: float,
    images: int,
    samples: int,
    corners: int,
    cut: float,
    draws: int,
    draw_seconds: float,
    seed: int,
) -> dict[str, Any]:
    """Calibrates cameras against an IMU, on a real recording and on simulated ones.

    Args:
        data: folder of the real recording, seen from the project; where it is missing that part is left out.
        real_seconds: how much of it.
        repeats: solutions of which the fastest counts.
        threads: for the real recording; simulated ones have one, as in the paper.
        order, spacing: of the splines. representations: of the simulated recording, split first.
        seconds, images, samples, corners: of the simulated recording; images of each of two cameras.
        cut: share of it on which product rule and automatic Jacobians are tried.
        draws: of noise, for the normalised estimation error; draw_seconds: how long those recordings are.
    """
    tables, figures = [], {}
    folder = ROOT / data
    if folder.is_dir():
        torch.set_num_threads(threads)
        options = {"order": order, "spacing": spacing}
        figures["real"] = real.everything(folder, real_seconds, repeats, options)
        tables += real_tables(figures["real"])
    torch.set_num_threads(1)
    size = {
        "seconds": seconds,
        "images": images,
        "samples": samples,
        "corners": corners,
        "distortion": "equidistant",
    }
    full = simulation.full_size(size, representations, order, spacing, repeats, seed)
    smaller = {
        key: max(round(x * cut), 1) if isinstance(x, int) else x
        for key, x in size.items()
        if key != "seconds"
    }
    times, found = simulation.variants(
        {**smaller, "seconds": seconds * cut}, representations, order, spacing, seed
    )
    table2 = simulation.largest_from_mean(list(found.values()))
    groups = [[x for (spline, _), x in found.items() if spline == r] for r in representations]
    each = [simulation.largest_from_mean(group) for group in groups]
    same = {name: max(x[name] for x in each) for name in table2}
    tables += simulated_tables(full, times, table2, same, cut)
    drawn = {
        "seconds": draw_seconds,
        "images": round(10 * draw_seconds),
        "samples": round(200 * draw_seconds),
    }
    nees = simulation.consistency(drawn, draws, order, 0.05, seed)
    tables.append(consistency_table(nees))
    show(out, tables)
    picture(out, nees)
    figures |= {
        "full_size": full,
        "variants": {" ".join(key): x for key, x in times.items()},
        "table2": {"six variants": table2, "of one spline": same, "paper": simulation.PAPER_DEVIATIONS},
        "consistency": nees,
    }
    return figures


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "real_seconds": 12.0, "repeats": 0, "seconds": 4.0, "images": 20, "samples": 500, "corners": 600,
            "cut": 0.75, "draws": 3, "draw_seconds": 2.0, "spacing": 0.05, "representations": ["split"],
        },
    )  # fmt: skip
