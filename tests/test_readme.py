"""The code in the README runs as it stands."""

import re
from pathlib import Path

import torch

README = Path(__file__).resolve().parent.parent / "README.md"


def test_readme_code_runs(tmp_path, monkeypatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    assert len(blocks) == 3
    assert blocks[0].count("\n") <= 14  # an example, not a tutorial
    torch.manual_seed(0)
    monkeypatch.chdir(tmp_path)  # where it might write files
    names: dict = {}
    for code in blocks:  # each goes on where the one before ended
        exec(code, names)
    assert names["reading"].gyroscope.shape == (100, 3)
    assert torch.isfinite(names["loss"])
    assert names["spline"].control_points.grad.abs().max() > 0
    assert names["result"].converged
    assert names["readings"].gyroscope.shape == (100, 3)
    assert names["batch"]["gyroscope"].shape == (8, 400, 3)


def test_readme_names_the_two_commands() -> None:
    text = README.read_text(encoding="utf-8")
    assert "pip install -c constraints.txt . && torchspline demo" in text
    assert "pip install -c constraints.txt -e '.[test]' && pytest" in text


def test_the_two_commands_are_near_the_top() -> None:
    lines = README.read_text(encoding="utf-8").splitlines()
    assert lines.index("## Two commands") < 35
    assert len(lines) < 160


def test_links_of_the_readme_lead_somewhere() -> None:
    text = README.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]+)(?:#([^)]+))?\)", text)
    assert len(links) > 10
    for path, anchor in links:
        target = README.parent / path
        if path.startswith(".github") and not target.exists():
            continue  # not part of an sdist
        assert target.is_file(), path
        heads = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.M)
        assert not anchor or anchor in {h.lower().replace(" ", "-") for h in heads}, f"{path}#{anchor}"
