"""Networks as programs of other programs."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from lightning_modules import exporting
from lightning_modules.__main__ import main
from lightning_modules.exporting import export_network
from lightning_modules.motion import ClassicalFlow, ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder
from spikekit import write_spikes

TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "blocks": 1, "end_blocks": 1}

ALONE = """
import sys
import numpy as np, onnxruntime
model, recording, out = sys.argv[1:]
packed = np.fromfile(recording, np.uint8).reshape(41, -1)
spikes = np.unpackbits(packed, axis=1, bitorder="little")[:, : 16 * 24].reshape(1, 41, 16, 24).astype(np.float32)
session = onnxruntime.InferenceSession(model)
names = [value.name for value in session.get_inputs()]
given = {"spikes": spikes, "flow": np.full((1, 2, 2, 16, 24), 0.5, np.float32)}
np.save(out, session.run(["rgb"], {name: given[name] for name in names})[0])
assert "torch" not in sys.modules
"""


def test_a_program_that_differs_from_the_network_is_not_written(tmp_path, monkeypatch):
    network = ClassicalDecoder("tfp", 2)
    monkeypatch.setattr(torch.export, "export", lambda *_, **__: None)
    monkeypatch.setattr(exporting, "_torch", lambda *_: b"a program")
    for wrong in (2e-4, float("nan")):
        run = lambda *inputs, wrong=wrong: network(*inputs) + wrong  # noqa: E731
        monkeypatch.setattr(exporting, "exported", lambda *_, run=run: run)
        with pytest.raises(ValueError, match=r"expected an export within 0\.0001 of the network, got (0\.0002|nan)"):
            export_network(network, tmp_path / "a.pt2", "torch")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(exporting, "exported", lambda *_: lambda *inputs: network(*inputs) + 5e-5)
    assert "within 5e-05 of the network" in export_network(network, tmp_path / "a.pt2", "torch")
    assert (tmp_path / "a.pt2").read_bytes() == b"a program"


@pytest.mark.slow
def test_a_program_of_torch_takes_any_even_size(tmp_path):
    network = CSCSR(scale=2, resolution="sensor", motion=ClassicalFlow(), **TINY).eval()
    said = export_network(network, tmp_path / "a.pt2", "torch")
    assert said.startswith("takes spikes and flow of any even height and width")
    run = torch.export.load(tmp_path / "a.pt2").module()
    spikes, flow = (torch.rand(1, 41, 20, 38) < 0.3).float(), 3 * torch.randn(1, 2, 2, 20, 38)
    with torch.no_grad():
        torch.testing.assert_close(run(spikes, flow), network(spikes, flow), rtol=0, atol=1e-4)


def test_what_cannot_be_exported_is_said_in_one_line(tmp_path):
    with pytest.raises(ValueError, match=r"CSCSR: cannot be exported \(steps, neighbors: expected rounded positions"):
        export_network(CSCSR(scale=2, steps=0, motion=ZeroFlow(), **TINY), tmp_path / "a.pt2", "torch")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("kind", "name"), [("torch", "a.onnx"), ("onnx", "a.pt2"), ("safetensors", "a.onnx")])
def test_the_name_ends_as_the_format_does(kind, name, tmp_path):
    with pytest.raises(SystemExit, match=r"^lightning: -o: expected a name that ends in"):
        main(["export", "cscsr_tiny_x4", "--format", kind, "-o", str(tmp_path / name)])


@pytest.mark.slow
def test_the_picture_of_a_recording_by_onnxruntime_alone(tmp_path):
    pytest.importorskip("onnxruntime", reason="the extra export is not installed")
    pytest.importorskip("onnxscript", reason="the extra export is not installed")
    network = CSCSR(scale=2, resolution="sensor", motion=ClassicalFlow(), **TINY).eval()
    export_network(network, tmp_path / "a.onnx", "onnx")
    spikes = torch.rand(41, 16, 24) < 0.3
    write_spikes(tmp_path / "a.dat", spikes)
    command = [sys.executable, "-c", ALONE, *(str(tmp_path / name) for name in ("a.onnx", "a.dat", "a.npy"))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    with torch.no_grad():
        expected = network(spikes[None].float(), torch.full((1, 2, 2, 16, 24), 0.5))
    assert np.abs(np.load(tmp_path / "a.npy") - expected.numpy()).max() < 1e-4


@pytest.mark.slow
def test_a_decoder_as_onnx(tmp_path):
    pytest.importorskip("onnxruntime", reason="the extra export is not installed")
    pytest.importorskip("onnxscript", reason="the extra export is not installed")
    assert export_network(ClassicalDecoder("tfp", 2), tmp_path / "a.onnx", "onnx").startswith("takes spikes of any")
