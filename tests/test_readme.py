"""The code in the README runs as it stands."""

import re
from pathlib import Path

import torch

README = Path(__file__).resolve().parent.parent / "README.md"


def test_readme_code_runs(tmp_path, monkeypatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    assert len(blocks) == 5
    torch.manual_seed(0)
    monkeypatch.chdir(tmp_path)  # where it writes files
    names: dict = {}
    for code in blocks:  # each goes on where the one before ended
        exec(code, names)
    assert names["gyroscope"].shape == (100, 3)
    assert torch.isfinite(names["loss"])
    assert names["result"].converged
    assert names["batch"]["gyroscope"].shape == (8, 400, 3)
    assert names["corrected"].gyroscope.shape == (100, 3)


def test_readme_names_the_two_commands() -> None:
    text = README.read_text(encoding="utf-8")
    assert "pip install -c constraints.txt . && torchspline demo" in text
    assert "pip install -c constraints.txt -e '.[test]' && pytest" in text
