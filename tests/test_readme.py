"""Commands and Python examples of README and quickstart, on small inputs."""

import re
import shlex
from pathlib import Path

import pytest
import torch

from lightning_modules.__main__ import main as lightning
from lightning_modules.sweep import cli as sweep
from lightning_modules.sweep.worker import train_and_test
from spikekit import simulate_spikes, write_picture, write_spikes
from spikekit.cli.command import main as spikekit

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
QUICKSTART = (ROOT / "docs" / "quickstart.rst").read_text()
PROGRAMS = {"lightning": lightning, "spikekit": spikekit}

# What makes a command small; everything else is as it is written.
SMALL = {"250": "24", "400": "32", "ablation/*": "ablation/c"}
SMALL |= {"onnx": "safetensors", "network.onnx": "network.safetensors"}  # whose tests take a minute
FEW = """
model: {network: {init_args: {size: tiny}}}
data: {init_args: {patch: 8, val_patch: 16, train_clips: 2, val_clips: 2, batch_size: 1, workers: 0}}
trainer: {max_steps: 2}
"""
ADDED = {
    "fit": ["-c", "few.yaml"],
    "test": ["-c", "few.yaml"],
    "sweep": ["-c", "few.yaml", "--steps", "2"],
    "trade": ["-c", "few.yaml", "--rounds", "1", "--setting", "--model.weights cscsr_tiny_x4"],
    "adapt": ["--steps", "2"],
}


def commands(text):
    """The commands in blocks of a page, without what installs; CI asks the package index and runs all tests."""
    blocks = re.findall(r"```(?:ba)?sh\n(.*?)```|\.\. code-block:: sh\n\n((?:   [^\n]*\n)+)", text, flags=re.DOTALL)
    for line in "".join(a or b for a, b in blocks).splitlines():
        for command in line.split(" && "):
            words = shlex.split(command, comments=True)
            if words and Path(words[0]).name in PROGRAMS:
                yield Path(words[0]).name, words[1:]


def light(frames, height, width):
    """A pattern that moves by a tenth of a pixel a clock."""
    x = torch.arange(width) - 0.1 * torch.arange(frames)[:, None, None]
    return 0.2 + 0.15 * torch.sin(x / 2 + torch.arange(height)[:, None] / 3)


@pytest.fixture(name="folder")
def _folder(tmp_path):
    """A folder with what the commands name: a recording, a film's frames, pictures."""
    write_spikes(tmp_path / "FILE.dat", simulate_spikes(light(221, 24, 32), generator=torch.Generator().manual_seed(0)))
    for n, frame in enumerate(light(3, 96, 128)[:, None].expand(-1, 3, -1, -1)):
        write_picture(tmp_path / "FRAMES" / f"{n}.png", frame)
        write_picture(tmp_path / "PICTURES" / f"{n}.png", frame)
    (tmp_path / "few.yaml").write_text(FEW)
    return tmp_path


IN_README = [*commands(README)]
ELSEWHERE = [command for command in commands(QUICKSTART) if command not in IN_README]


@pytest.mark.parametrize("typed", [IN_README, ELSEWHERE], ids=["readme", "quickstart"])
def test_commands_run_as_written(typed, folder, typed_in, monkeypatch):
    # trials run in the process of the command; another would import everything anew
    monkeypatch.setitem(sweep._ENGINES, "local", lambda trials, *_: [{one: train_and_test(one, 60) for one in trials}])
    outputs = 0
    for program, words in typed:
        words = [SMALL.get(word, word) for word in words] + ADDED.get(words[0], [])
        assert typed_in(folder, PROGRAMS[program], words) == 0, words
        if "-o" in words:
            outputs += 1
            assert (folder / words[words.index("-o") + 1]).exists(), words
    assert outputs >= 4


def test_python_example_reconstructs_a_recording(folder, monkeypatch):
    (code,) = re.findall(r"```python\n(import lightning_modules\n.*?)```", README, flags=re.DOTALL)
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(code.replace("height=250, width=400", "height=24, width=32"), names)
    assert len(names["pictures"]) == 7  # two spike frames are joined in this light
    assert names["rgb"].shape == (3, 96, 128)
    assert 0 <= names["rgb"].min() < names["rgb"].max() <= 1


def test_operator_example_runs_with_gradients():
    (code,) = re.findall(r"```python\n(import torch\n.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["moved"].shape == (1, 1, 16, 16)
    for leaf in (names["scene"], names["flow"]):
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().sum() > 0
    assert torch.equal(names["same"], names["raw"])
    assert not torch.equal(names["moved"][0, 0], names["raw"])


def test_named_files_and_options_exist():
    address = r"https://(?:raw\.githubusercontent\.com/spikekit/spikekit/main|github\.com/spikekit/spikekit/(?:blob|tree)/main)/"
    named = re.findall(address + r"([\w./]+)", README) + re.findall(r"(?:configs|docs)/[\w/]+\.(?:yaml|py)", README)
    assert len(named) > 7
    for name in named:
        assert (ROOT / name).exists(), name
    assert not re.findall(r"\]\((?!http)", README), "links that PyPI cannot follow"


def test_figures_match_the_tables():
    rows = [row.split(",") for row in (ROOT / "results" / "vid4.csv").read_text().splitlines()[1:]]
    for row in re.findall(r"^\| x(\d)(, 8 clocks)?.*? \| (.*) \|$", README, flags=re.MULTILINE):
        (found,) = [r for r in rows if r[0] == row[0] and (r[1] == "8") == bool(row[1])]
        cells = [cell for group in row[2].split("|") for cell in group.replace(",", " ").split()]
        assert cells == [found[4], *(cell for cell in found[5:] if cell)], row


def test_readme_has_at_most_140_lines():
    assert len(README.splitlines()) <= 140


def test_first_commands_are_those_of_ci():
    train, test = re.findall(r"```sh\n(.*?)\n```", README, flags=re.DOTALL)[:2]
    assert "-c quick" in train
    assert train.endswith("--ckpt_path best")
    assert test.endswith("pytest -n auto")
