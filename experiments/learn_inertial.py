"""Calibration of an IMU learnt from generated data, tried on real recordings: orientation from the gyroscope alone.

A network (`learning/estimator.py`) that has seen nothing but generated motions and sensors is given gyroscope and
accelerometer of a real recording. With the biases and scales that it finds, readings are corrected through the sensor
model and the gyroscope is integrated; poses serve to measure errors, of 1 s, 5 s and 10 s and of the whole run from its
first pose on, and for nothing else. Compared with: no correction; the mean of the stillest second among the first 20 as
bias (the usual practice, which needs a rest); the same least squares without a network and training; and the constant
bias that the poses themselves tell, about the most that can be had. Poses of EuRoC come from a fusion that used the
same IMU, those of TUM VI from motion capture. No parameter was trained on these recordings, but
they were looked at while motions, sensors and the network were chosen.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from common import ROOT, Table, run, save, show
from learning.estimator import GROUP, Calibration, Calibrator
from learning.evaluation import Errors, bias_from_poses, orientation_errors, rms, stillest
from learning.training import LAGS, Training, batches, train, train_in_processes
from matplotlib.figure import Figure
from recordings.load import Recording, load
from torch import Tensor

from torchspline.generate import Recipe

#: How often the last step is repeated for a recording: until nothing changes.
REPEATED = 6
#: Losses of one process and of two may differ by this much, relative.
ROUNDING = 1e-9
DEGREES = 180.0 / torch.pi


def calibrate(model: Calibrator, recording: Recording, lengths: list[float]) -> Calibration:
    """From all readings of a recording, and nothing else."""
    samples = recording.samples
    count = len(samples) // GROUP * GROUP
    dt = samples.seconds().diff().mean().item()
    with torch.no_grad():
        return model(
            samples.gyroscope[None, :count],
            samples.accelerometer[None, :count],
            dt,
            [*lengths, *[lengths[-1]] * REPEATED],
        )


def corrected(
    recording: Recording, calibration: Calibration, only_bias: bool = False, model: Calibrator | None = None
) -> Tensor:
    """The gyroscope's readings; with a model, denoised by it."""
    samples = recording.samples
    if only_bias:
        bias = calibration.gyroscope_bias
        calibration = Calibration.perfect(bias)._replace(gyroscope_bias=bias)
    with torch.no_grad():
        found = calibration.correct(samples.gyroscope[None], samples.accelerometer[None]).gyroscope
        return (found if model is None else model.denoised(found))[0]


def denoising(model: Calibrator, training: Training, seed: int) -> tuple[float, float]:
    """RMS [rad/s] of what differs between neighbouring errors of the gyroscope, before and after the filter."""
    batch = next(batches(training._replace(steps=1), seed, 1))
    with torch.no_grad():
        smooth = model.denoised(batch["gyroscope"])
    before, after = (
        rms((x - batch["angular_velocity"]).diff(dim=1)) / 2**0.5 for x in (batch["gyroscope"], smooth)
    )
    return before, after


def processes_agree(training: Training, steps: int, seed: int) -> tuple[list[float], list[float], float]:
    """Losses of one process and of two that share each batch, and the largest relative difference."""
    short = training._replace(recipes=training.recipes[:1], steps=steps, blocks=2)
    _, alone = train(short, seed)
    with tempfile.TemporaryDirectory() as folder:
        together = train_in_processes(short, seed, 2, Path(folder) / "meeting")
    return alone, together, max(abs(a - b) / abs(a) for a, b in zip(alone, together, strict=True))


def experiment(
    out: Path,
    data: str,
    recordings: list[str],
    seeds: list[int],
    steps: int,
    blocks: int,
    learning_rate: float,
    width: int,
    lengths: list[float],
    biases: list[float],
    process_steps: int,
    recipe: dict[str, Any],
) -> dict[str, Any]:
    """Train on generated data, calibrate real recordings, and integrate their gyroscopes.

    Args:
        out: folder for the results.
        data: folder of the recordings, from the root of the project.
        recordings: which; "synthetic" needs no data.
        seeds: of data and networks, one training each.
        steps: of the optimiser.
        blocks: of items of each sensor quality that a step sees.
        learning_rate: highest one of the schedule.
        width: channels of the network.
        lengths: s, of the stretches at each Gauss-Newton step.
        biases: standard deviations of the gyroscope bias of poor and of good sensors, rad/s.
        process_steps: of the check that two processes train as one does.
        recipe: motions and sensors of the generated data.
    """
    torch.set_num_threads(1)
    common = Recipe(**recipe)
    recipes = [
        replace(common, sensor={**common.sensor, "gyroscope_bias": {"normal": [0.0, x]}}) for x in biases
    ]
    training = Training(recipes, lengths, steps, blocks, learning_rate, width)
    alone, together, difference = processes_agree(training, process_steps, seeds[0])
    if difference > ROUNDING:
        raise RuntimeError(f"two processes do not train as one does: losses {together} and {alone}")
    print(f"two processes train as one does, to {difference:.1e}", flush=True)
    trained = [train(training, seed) for seed in seeds]
    noise = [
        denoising(model, training, 10_000 + seed) for (model, _), seed in zip(trained, seeds, strict=True)
    ]

    untrained = Calibrator(width=0).to(torch.float64)
    errors: dict[str, dict[str, list[Errors]]] = {}
    found: dict[str, Any] = {}
    for name in recordings:
        recording = load(ROOT / data, name, seed=0)
        raw = recording.samples.gyroscope
        simple = {
            "none": raw,
            "stillest second": raw - stillest(recording),
            "least squares alone": corrected(recording, calibrate(untrained, recording, lengths)),
        }
        errors[name] = {method: [orientation_errors(recording, x)] for method, x in simple.items()}
        calibrations = [calibrate(model, recording, lengths) for model, _ in trained]
        for method, only_bias, denoise in (
            ("network", False, False), ("network, bias only", True, False), ("network, denoised", False, True),
        ):  # fmt: skip
            errors[name][method] = [
                orientation_errors(recording, corrected(recording, c, only_bias, model if denoise else None))
                for c, (model, _) in zip(calibrations, trained, strict=True)
            ]
        errors[name]["bias from the poses"] = [
            orientation_errors(recording, raw - bias_from_poses(recording))
        ]
        found[name] = {
            "gyroscope_bias": [c.gyroscope_bias[0] for c in calibrations],
            "gyroscope_scale": [c.gyroscope_scale[0] for c in calibrations],
            "accelerometer_bias": [c.accelerometer_bias[0] for c in calibrations],
            "bias_from_poses": bias_from_poses(recording),
            "stillest_second": stillest(recording),
        }
    show(out, [*_tables(errors, seeds), _about(noise, difference, process_steps)])
    save(_figure(errors, [losses for _, losses in trained]), out / "learn_inertial.png")
    return {
        "errors_deg": {
            name: {method: [_degrees(e) for e in runs] for method, runs in methods.items()}
            for name, methods in errors.items()
        },
        "factor_at_10_s": {name: _factors(methods) for name, methods in errors.items()},
        "calibrations": found,
        "noise_rad_s": noise,
        "losses": [losses for _, losses in trained],
        "losses_of_one_process": alone,
        "losses_of_two_processes": together,
        "relative_difference": difference,
    }


def _degrees(e: Errors) -> dict[str, float]:
    named = {f"{lag:g} s": x for lag, x in zip(LAGS, e.lags, strict=True)}
    return {name: x * DEGREES for name, x in {**named, "whole run": e.whole, "its tilt": e.tilt}.items()}


def _factors(methods: dict[str, list[Errors]]) -> dict[str, list[float]]:
    """By how much the error over the longest lag falls, for each seed."""
    before = methods["none"][0].lags[-1]
    return {method: [before / e.lags[-1] for e in runs] for method, runs in methods.items()}


def _spread(values: list[float], digits: int) -> str:
    x = torch.tensor(values)
    mean = f"{x.mean():.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {x.std():.{digits}f}"


def _tables(errors: dict[str, dict[str, list[Errors]]], seeds: list[int]) -> list[Table]:
    tables = []
    for name, methods in errors.items():
        columns = list(_degrees(methods["none"][0]))
        rows = [
            [
                method,
                *(_spread([_degrees(e)[column] for e in runs], 2) for column in columns),
                _spread(_factors(methods)[method], 1),
            ]
            for method, runs in methods.items()
        ]
        header = ["correction", *(f"{column} [deg]" for column in columns), "none / this, 10 s"]
        title = f"{name}: RMS orientation error of the integrated gyroscope, {len(seeds)} seeds"
        tables.append(Table(title, header, rows))
    return tables


def _about(noise: list[tuple[float, float]], difference: float, steps: int) -> Table:
    rows = [
        ["noise of generated gyroscopes [rad/s]", _spread([a for a, _ in noise], 5)],
        ["the same, denoised [rad/s]", _spread([b for _, b in noise], 5)],
        [f"losses of two processes and one over {steps} steps, relative difference", f"{difference:.1e}"],
    ]
    return Table("generated data", ["", "value"], rows)


def _figure(errors: dict[str, dict[str, list[Errors]]], losses: list[list[float]]) -> Figure:
    count = len(errors) + 1
    lines = -(-count // 3)
    figure = Figure(figsize=(13, 3.6 * lines), layout="constrained")
    panels = figure.subplots(lines, 3, squeeze=False).flatten()
    colors = {"none": "0.5", "stillest second": "C0", "network": "C3", "bias from the poses": "C2"}
    for axes, (name, methods) in zip(panels, errors.items(), strict=False):
        for method, color in colors.items():
            for i, e in enumerate(methods[method]):
                axes.semilogy(
                    e.time[1:], e.angle[1:] * DEGREES, color=color, linewidth=1,
                    label=None if i else method,
                )  # fmt: skip
        axes.set(title=name, xlabel="time [s]", ylabel="angle [deg]", ylim=(0.05, 200))
        axes.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    for x in losses:
        panels[count - 1].plot(x, color="C3", linewidth=1)
    panels[count - 1].set(title="training on generated data", xlabel="step", ylabel="loss")
    panels[count - 1].grid(alpha=0.3)
    for axes in panels[count:]:
        axes.remove()
    return figure


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "recordings": ["synthetic"],
            "seeds": [0],
            "steps": 2,
            "width": 4,
            "lengths": [3.0, 6.0],
            "process_steps": 2,
            "recipe": {"motions": {"smooth": {}}, "sensor": {}, "duration": 6.0, "rate": 200.0},
        },
    )
