"""Data sets on disk: complete or not there, the same bytes whoever writes them and however often they are killed."""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from torchspline import cli
from torchspline.generate import GeneratedDataset, Recipe, items_per_block, read, shards, write
from torchspline.generate.blocks import compute_block

pytest.importorskip("pyarrow", reason="pip install 'torchspline[generate]' brings it")

RECIPE = Recipe(
    motions={"smooth": {"bandwidth": 1.0}, "walking": {}},
    sensor={"gyroscope_noise_density": 1e-3, "gyroscope_bias": {"normal": [0.0, 0.02]}},
    duration=0.4,
    rate=50.0,
)
ITEMS, PER_SHARD = 700, 200

CONFIG = """
seed: 4
items: 2100
items_per_shard: 256
recipe:
  duration: 0.5
  rate: 50.0
  motions: {drone: {bandwidth: {uniform: [0.5, 1.0]}}, figure_eight: {}}
  sensor: {gyroscope_noise_density: 1e-3, accelerometer_bias: {normal: [0.0, 0.1]}}
"""


def hashes(folder: Path) -> dict[str, str]:
    """Of all there is, hidden files included."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "made" / "here"
    calls: list[tuple[int, int]] = []
    done = write(
        RECIPE, path, seed=7, items=ITEMS, items_per_shard=PER_SHARD, progress=lambda *x: calls.append(x)
    )
    assert done == (4, ITEMS, 0)
    assert calls == [(200, 700), (400, 700), (600, 700), (700, 700)]
    return path


def test_what_is_read_is_what_was_generated(folder):
    data = read(folder)
    assert len(data) == ITEMS
    assert [path.name for path in data.files] == [f"shard-{i:06d}.parquet" for i in range(4)]
    for i, item in enumerate(GeneratedDataset(RECIPE, seed=7, count=ITEMS)):
        found = data[i]
        assert found.keys() == item.keys()
        for name, x in item.items():
            same = (
                torch.equal(x, found[name]) and x.dtype == found[name].dtype
                if torch.is_tensor(x)
                else x == found[name]
            )
            assert same, (i, name)
    assert data[-1]["index"] == ITEMS - 1
    with pytest.raises(IndexError, match="index: expected one below 700, got 700"):
        data[ITEMS]
    batch = next(iter(DataLoader(data, batch_size=5, shuffle=True, num_workers=0)))
    assert batch["gyroscope"].shape == (5, 20, 3)
    assert data.manifest["recipe"]["motions"]["walking"] == {}


def test_other_programs_can_read_the_shards(folder):
    """Fixed-shape tensors of Arrow, one row an item, with the index in a column of its own."""
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(folder / "shard-000003.parquet")
    assert table.num_rows == 100
    assert table["index"].to_pylist() == list(range(600, 700))
    assert table.schema.field("gyroscope").type.shape == [20, 3]
    gyroscope = table["gyroscope"].combine_chunks().to_numpy_ndarray()
    size = items_per_block(RECIPE)
    block = compute_block(RECIPE, 7, 600 // size)["gyroscope"]
    assert torch.equal(torch.from_numpy(gyroscope[0].copy()), block[600 % size])


def test_shards_do_not_depend_on_how_many_write(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "3")
    for rank in (2, 0, 1):
        monkeypatch.setenv("RANK", str(rank))
        done = write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=PER_SHARD)
        assert done.shards == (2 if rank == 0 else 1)
    assert hashes(tmp_path) == hashes(folder)


def test_writing_again_writes_what_is_missing_and_nothing_else(folder, tmp_path):
    write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=PER_SHARD)
    before = (tmp_path / "shard-000000.parquet").stat().st_mtime_ns
    (tmp_path / "shard-000001.parquet").unlink()
    torn = tmp_path / "shard-000002.parquet"
    torn.write_bytes(torn.read_bytes()[:-100])
    (tmp_path / ".shard-000001.parquet.123.tmp").write_bytes(b"torn")
    (tmp_path / ".dataset.json.123.tmp").write_bytes(b"torn")
    assert write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=PER_SHARD) == (2, 400, 2)
    assert hashes(tmp_path) == hashes(folder)
    assert (tmp_path / "shard-000000.parquet").stat().st_mtime_ns == before


def test_a_shard_has_its_name_only_when_it_is_complete(tmp_path, monkeypatch):
    def failing(recipe, seed, number):
        assert {path.suffix for path in tmp_path.iterdir()} <= {".json", ".tmp"}
        if number == 1:
            raise KeyboardInterrupt
        return compute_block(recipe, seed, number)

    monkeypatch.setattr(shards, "compute_block", failing)
    with pytest.raises(KeyboardInterrupt):
        write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=ITEMS)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.json"]


def test_another_data_set_is_not_mixed_in(folder, tmp_path):
    for changes, name in (
        ({"seed": 8}, "seed: expected 8, got 7"),
        ({"items": 701}, "items: expected 701, got 700"),
        ({"recipe": Recipe(**{**RECIPE.as_dict(), "rate": 100.0})}, "recipe: expected"),
    ):
        arguments = {"recipe": RECIPE, "seed": 7, "items": ITEMS, "items_per_shard": PER_SHARD, **changes}
        with pytest.raises(ValueError, match=f"folder: .* holds another data set.*{name}"):
            write(folder=folder, **arguments)
    # Also where the manifest is lost, and a shard is all there is.
    write(RECIPE, tmp_path, seed=8, items=ITEMS, items_per_shard=ITEMS)
    (tmp_path / "dataset.json").unlink()
    with pytest.raises(ValueError, match="belongs to another data set"):
        write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=ITEMS)


def test_incomplete_and_damaged_data_sets_are_not_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"folder: expected dataset.json in it"):
        read(tmp_path)
    write(RECIPE, tmp_path, seed=7, items=ITEMS, items_per_shard=PER_SHARD)
    shard = tmp_path / "shard-000002.parquet"
    content = shard.read_bytes()
    shard.unlink()
    with pytest.raises(FileNotFoundError, match=r"1 are missing \(shard-000002.parquet\); generate again"):
        read(tmp_path)
    shard.write_bytes(content[:-50])
    with pytest.raises(ValueError, match=r"shard-000002.parquet is damaged; remove it"):
        read(tmp_path)
    middle = len(content) // 2
    shard.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    with pytest.raises(ValueError, match=r"shard-000002.parquet is damaged"):
        [read(tmp_path)[i] for i in range(400, 600)]
    (tmp_path / "dataset.json").write_text(json.dumps({"format": "other"}))
    with pytest.raises(ValueError, match="expected a data set of format 'torchspline items 1'"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: x[: len(x) // 2], "dataset.json is damaged: .*choose another folder"),
        (lambda x: "", "dataset.json is damaged"),
        (lambda x: "[]", r"expected a data set of format .*, got \[\]"),
        (lambda x: x.replace('"shards": 1', '"shards": "x"'), "shards: expected a whole number.* got 'x'"),
        (lambda x: '{"format": "torchspline items 1"}', "items: expected a whole number.* got None"),
    ],
)
def test_a_damaged_manifest_is_named(tmp_path, change, said):
    arguments = {"seed": 7, "items": 3, "items_per_shard": 3}
    write(RECIPE, tmp_path, **arguments)
    path = tmp_path / "dataset.json"
    path.write_text(change(path.read_text()))
    for call in (lambda: read(tmp_path), lambda: write(RECIPE, tmp_path, **arguments)):
        with pytest.raises(ValueError, match=f"folder: .*{said}"):
            call()


def test_a_folder_in_place_of_a_shard_is_named(tmp_path):
    write(RECIPE, tmp_path, seed=7, items=3)
    path = tmp_path / "shard-000000.parquet"
    path.unlink()
    path.mkdir()
    with pytest.raises(ValueError, match=r"shard-000000.parquet to be a file, got a folder; remove it"):
        write(RECIPE, tmp_path, seed=7, items=3)


def test_items_are_asked_for_by_whole_numbers(folder):
    data = read(folder)
    for bad in (slice(1, 3), 1.5, "1"):
        with pytest.raises(TypeError, match=f"index: expected a whole number, got {type(bad).__name__}"):
            data[bad]


def test_without_pyarrow_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for function in (lambda: read(tmp_path), lambda: write(RECIPE, tmp_path, seed=0, items=1)):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchspline\[generate\]'"):
            function()


# ---------------------------------------------------------------------- as processes


def command(config: Path, out: Path, *more: str) -> list[str]:
    return ["-m", "torchspline.cli", "generate", "--config", str(config), "--out", str(out), *more]


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("config") / "generate.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def undisturbed(config, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed")
    assert write(Recipe.load(config), out, seed=4, items=2100, items_per_shard=256).shards == 9
    return out


def test_killed_again_and_again_the_data_set_is_the_same(config, undisturbed, tmp_path):
    chance = random.Random(0)
    kills = 0
    for _ in range(20):
        there = len(list(tmp_path.glob("*.parquet")))
        process = subprocess.Popen([sys.executable, *command(config, tmp_path)], stdout=subprocess.DEVNULL)
        # Once it has begun to write, at any moment.
        deadline = time.monotonic() + 300
        while len(list(tmp_path.glob("*.parquet"))) <= there and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.1))
        process.send_signal(signal.SIGKILL)
        process.wait()
        if process.returncode == 0:  # all written while this process waited for its turn: from the beginning
            shutil.rmtree(tmp_path)
            kills = 0
            continue
        assert process.returncode == -signal.SIGKILL
        kills += 1
        if kills == 2:
            break
    assert kills == 2
    done = subprocess.run(
        [sys.executable, *command(config, tmp_path)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert hashes(tmp_path) == hashes(undisturbed)
    found = [item["index"].item() for item in map(read(tmp_path).__getitem__, range(2100))]
    assert found == list(range(2100))


def test_two_processes_write_what_one_writes(config, undisturbed, tmp_path):
    out = tmp_path / "out"
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *torchrun, *command(config, out, "--json")],
        capture_output=True, text=True, timeout=300, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert sorted((r["rank"], r["shards"]) for r in reports) == [(0, 5), (1, 4)]
    assert hashes(out) == hashes(undisturbed)


def test_the_command_tells_what_it_did_and_what_is_wrong(config, undisturbed, monkeypatch, capsys):
    def run(*more: str) -> int:
        monkeypatch.setattr(sys, "argv", ["torchspline", *command(config, undisturbed, *more)[2:]])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return caught.value.code

    assert run("--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["shards"], report["kept"], report["rank"], report["world_size"]) == (0, 9, 0, 1)
    assert run() == 0
    assert "9 shards were there" in capsys.readouterr().out
    for more, message in (
        (("--seed", "5"), "holds another data set, with other seed"),
        (("--recipe.motions", "{drone: {drag: {uniform: [1]}}}"), "motions.drone.drag.uniform: expected 2"),
        (("--items", "0"), "items: expected a whole number of at least 1, got 0"),
    ):
        assert run(*more) == 2
        assert message in capsys.readouterr().err
