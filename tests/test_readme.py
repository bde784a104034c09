"""What README and quickstart say is what happens: every command and every line of Python, on small inputs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from spikekit import simulate_spikes, write_picture, write_spikes

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
QUICKSTART = (ROOT / "docs" / "quickstart.rst").read_text()

# What makes a command small; everything else is as it is written.
SMALL = [("--height 250 --width 400", "--height 24 --width 32"), ("lightning adapt", "lightning adapt --steps 2")]


def light(frames, height, width):
    """A pattern that moves by a tenth of a pixel a clock."""
    x = torch.arange(width) - 0.1 * torch.arange(frames)[:, None, None]
    return 0.2 + 0.15 * torch.sin(x / 2 + torch.arange(height)[:, None] / 3)


@pytest.fixture
def folder(tmp_path):
    """A folder with what the commands name: a recording, a film's frames, pictures, and configurations."""
    write_spikes(tmp_path / "FILE.dat", simulate_spikes(light(260, 24, 32), generator=torch.Generator().manual_seed(0)))
    for n, frame in enumerate(light(4, 96, 128)[:, None].expand(-1, 3, -1, -1)):
        write_picture(tmp_path / "FRAMES" / f"{n}.png", frame)
        write_picture(tmp_path / "PICTURES" / f"{n}.png", frame)
    return tmp_path


def typed(commands, folder):
    """Run commands one after the other, as somebody types them, and return what they say."""
    for small in SMALL:
        commands = commands.replace(*small)
    scripts = {
        "spikekit": "from spikekit.cli.command import main; raise SystemExit(main())",
        "lightning": "from lightning_modules.__main__ import main; main()",
    }
    defined = [f"{name}() {{ '{sys.executable}' -c '{code}' \"$@\"; }}" for name, code in scripts.items()]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    script = "\n".join(["set -eux", *defined, commands])
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done


def outputs(commands):
    return [Path(name) for name in re.findall(r" -o (\S+)", commands)]


def test_commands_of_the_readme_on_a_recording_run_as_written(folder):
    commands = next(block for block in re.findall(r"```bash\n(.*?)```", README, flags=re.DOTALL) if "predict" in block)
    commands = re.sub("^pip install .*", "", commands)  # what pip finds, .ci/resolve asks
    typed(commands, folder)
    assert len(outputs(commands)) >= 5
    for path in outputs(commands):
        assert (folder / path).exists(), path


def test_commands_of_the_quickstart_run_as_written(folder):
    (commands,) = re.findall(r"\.\. code-block:: sh\n\n((?:   .*\n)+)", QUICKSTART)
    typed(commands, folder)
    assert len(outputs(commands)) >= 4
    for path in outputs(commands):
        assert (folder / path).exists(), path


def test_the_readmes_call_in_python_gives_the_pictures_of_a_recording(folder, monkeypatch):
    (code,) = re.findall(r"```python\n(import lightning_modules\n.*?)```", README, flags=re.DOTALL)
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(code.replace("height=250, width=400", "height=24, width=32"), names)
    assert len(names["pictures"]) == 11
    assert names["rgb"].shape == (3, 96, 128)
    assert 0 <= names["rgb"].min() < names["rgb"].max() <= 1


def test_the_readmes_operators_run_and_gradients_reach_scene_and_motion():
    (code,) = re.findall(r"```python\n(import torch\n.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["moved"].shape == (1, 1, 16, 16)
    for leaf in (names["scene"], names["flow"]):
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().sum() > 0
    assert torch.equal(names["same"], names["raw"])
    assert not torch.equal(names["moved"][0, 0], names["raw"])


def test_what_the_readme_names_is_there():
    address = r"https://(?:raw\.githubusercontent\.com/spikekit/spikekit/main|github\.com/spikekit/spikekit/(?:blob|tree)/main)/"
    named = re.findall(address + r"([\w./]+)", README) + re.findall(r"(?:configs|docs)/[\w/]+\.(?:yaml|py)", README)
    assert len(named) > 7
    for name in named:
        assert (ROOT / name).exists(), name
    assert not re.findall(r"\]\((?!http)", README), "links that PyPI cannot follow"


def test_the_readmes_figures_are_those_of_the_table():
    rows = [row.split(",") for row in (ROOT / "results" / "vid4.csv").read_text().splitlines()[1:]]
    for row in re.findall(r"^\| x(\d)(, fast)?.*? \| (.*) \|$", README, flags=re.MULTILINE):
        (found,) = [r for r in rows if r[0] == row[0] and (r[1] == "8") == bool(row[1])]
        cells = [cell for group in row[2].split("|") for cell in group.replace(",", " ").split()]
        assert cells == [found[4], *(cell for cell in found[5:] if cell)], row


def test_it_is_read_in_a_few_minutes():
    assert len(README.splitlines()) <= 140


def test_its_first_two_commands_are_those_that_ci_runs():
    train, test = re.findall(r"```sh\n(.*?)\n```", README, flags=re.DOTALL)[:2]
    assert "-c quick" in train
    assert train.endswith("--ckpt_path best")
    assert test.endswith("pytest -n auto")
