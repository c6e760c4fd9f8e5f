"""The survey [H18] measured again: its Figures 1 to 6, the runtimes of its Table 2 and its overview of methods."""

from pathlib import Path
from typing import Any

import torch
from common import Table, run, show
from interpolation.choose import page
from interpolation.figures import figure_1, figure_2, figure_3, figure_4, figure_5_drawn, figure_6_drawn
from interpolation.measure import properties, runtime
from interpolation.orders import FAMILIES, family_order, needs, order

from torchspline.splines.interpolation import SURVEY

#: [H18] Table 2: nanoseconds an evaluation on an i7-8700K at 3.7 GHz, g++ 7.3.0, one at a time. Its CuBsp and SQUAD of
#: rigid motions are split ones.
TABLE_2 = {
    "QLB+LERP": 10,
    "DLB": 23,
    "SPLIT": 103,
    "ScLERP": 127,
    "SE3Up": 200,
    "DLFus": 167,
    "SPLIT SQUAD": 189,
    "SPLIT CuBsp": 319,
    "ScFus": 428,
    "SpFus": 675,
}


def _rows(figures: dict[str, float]) -> list[list[str]]:
    return [[name, f"{x:.3g}"] for name, x in figures.items()]


def experiment(
    out: Path, batch: int, repetitions: int, threads: int, tolerance: float, seed: int
) -> dict[str, Any]:
    """Figures 1 to 6 and Table 2 of the survey of interpolation methods, an overview of what was measured, and which
    spline to use (`which_spline.md`), decided by that.

    Args:
        out: folder for the results.
        batch: evaluations at once for the runtimes.
        repetitions: of each timing; the fastest counts.
        threads: of torch while timing.
        tolerance: m and rad, to which a smooth motion is followed by every family.
        seed: of the keys.
    """
    for draw in (figure_1, figure_2, figure_3):
        draw(out)
    jumps, half_circle, coupling = figure_4(out), figure_5_drawn(out), figure_6_drawn(out)

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        times = {name: runtime(name, batch, repetitions, 0, seed) for name in SURVEY}
        rates = {name: runtime(name, batch, repetitions, 2, seed) for name in TABLE_2}
        families = {name: needs(name, tolerance, batch, repetitions, seed) for name in FAMILIES}
    finally:
        torch.set_num_threads(before)
    measured = {name: {**properties(name, seed), "order": order(name, seed)} for name in SURVEY}
    for name, case in families.items():
        case["order"] = family_order(name, seed)
    (out / "which_spline.md").write_text(page(measured, times, families, tolerance), encoding="utf-8")

    runtimes = [
        [name, f"{paper}", f"{times[name]:.0f}", f"{paper / times[name]:.1f}", f"{rates[name]:.0f}"]
        for name, paper in TABLE_2.items()
    ]
    overview = [
        [
            name,
            case["group"],
            "interpolates" if case["interpolates"] else "approximates",
            f"C{case['continuous_derivatives']}" if SURVEY[name].scheme not in ("bezier",) else "smooth",
            f"local ({case['segments_moved_by_a_key']} segments a key)" if case["local"] else "global",
            case["numbers_per_key"],
            case["derivatives"],
            "-" if case["order"] is None else f"{case['order']:.1f}",
            f"{times[name]:.0f}",
        ]
        for name, case in measured.items()
    ]
    show(
        out,
        [
            Table("Figure 4: largest jump of the angular velocity at a key [rad/s]", ["", ""], _rows(jumps)),
            Table("Figure 5: two poses half a turn apart", ["", ""], _rows(half_circle)),
            Table("Figure 6: largest distances between positions [m]", ["", ""], _rows(coupling)),
            Table(
                f"Table 2: nanoseconds an evaluation (ours in batches of {batch}, {threads} thread)",
                ["method", "survey, C++", "ours", "ratio", "ours with velocity and acceleration"],
                runtimes,
            ),
            Table(
                "Overview, as measured",
                [
                    "method",
                    "group",
                    "keys",
                    "continuity",
                    "control",
                    "numbers a key",
                    "derivatives",
                    "order",
                    "ns",
                ],
                overview,
            ),
            Table(
                f"A smooth motion in SE(3) followed to {tolerance:g} m and rad",
                ["family", "order of convergence", "numbers", "ns for pose, velocity, acceleration"],
                [[n, f"{x['order']:.1f}", x["numbers"], f"{x['ns']:.0f}"] for n, x in families.items()],
            ),
        ],
    )
    return {
        "velocity_jumps": jumps,
        "figure_5": half_circle,
        "figure_6": coupling,
        "runtime_ns": times,
        "runtime_with_rates_ns": rates,
        "survey_ns": TABLE_2,
        "properties": measured,
        "families": families,
    }


if __name__ == "__main__":
    run(experiment, smoke={"batch": 500, "repetitions": 2})
