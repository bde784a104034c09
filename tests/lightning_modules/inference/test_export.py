"""Export of networks for other programs."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from lightning_modules.inference import export
from lightning_modules.inference.export import as_exported, difference, example_inputs, export_network
from lightning_modules.motion import ClassicalFlow, ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder, RecurrentCSCSR, SpikeSRNetLike
from spikekit import write_spikes

TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "blocks": 1, "end_blocks": 1}

FILM = {**TINY, "features": 2, "fusion_width": 4, "fusion_blocks": 1, "memory": 2}
#: of every kind of part one: an export of any network is compared with it before it is written
MADE = [
    (CSCSR, {**TINY, "motion_fusion": "assembled", "resolution": "sensor"}),
    (RecurrentCSCSR, FILM),
    (SpikeSRNetLike, {"width": 8, "maps": 4, "corrections": 1, "per_channel": True}),
]

ALONE = """
import sys
import numpy as np, onnxruntime
model, recording, out = sys.argv[1:]
packed = np.fromfile(recording, np.uint8).reshape(41, -1)
spikes = np.unpackbits(packed, axis=1, bitorder="little")[:, : 16 * 24].reshape(1, 41, 16, 24).astype(np.float32)
session = onnxruntime.InferenceSession(model)
given = {"spikes": spikes, "flow": np.full((1, 2, 2, 16, 24), 0.5, np.float32)}
np.save(out, session.run(["rgb"], {one.name: given[one.name] for one in session.get_inputs()})[0])
assert "torch" not in sys.modules
"""


@pytest.mark.parametrize("wrong", [2e-4, float("nan")])
def test_programs_that_differ_from_the_network_are_rejected(tmp_path, monkeypatch, wrong):
    network = ClassicalDecoder("tfp", 2)
    monkeypatch.setattr(torch.export, "export", lambda *_, **__: None)
    monkeypatch.setattr(export, "_torch", lambda *_: b"a program")
    # of some sizes alone
    differs = lambda spikes: network(spikes) + (wrong if spikes.shape[-1] > spikes.shape[-2] else 0)  # noqa: E731
    monkeypatch.setattr(export, "exported", lambda *_: differs)
    with pytest.raises(ValueError, match=r"expected an export within 0\.0001 of the network, got (0\.0002|nan)"):
        export_network(network, tmp_path / "a.pt2", "torch")
    assert not list(tmp_path.iterdir())


def unlike_at_first(network):
    """A network whose layers that begin at zero say something."""
    generator = torch.Generator().manual_seed(0)
    for weight in network.parameters():
        weight.data += 0.02 * torch.randn(weight.shape, generator=generator)
    return network.eval()


@pytest.fixture(name="program")
def _program(monkeypatch):
    """What export_network has loaded of its bytes to compare it, by the path of the file: to load it takes seconds."""
    loaded, load = {}, export.exported

    def exported(data, kind):
        loaded[data] = load(data, kind)
        return loaded[data]

    monkeypatch.setattr(export, "exported", exported)
    return lambda path: loaded[path.read_bytes()]


def sizes_differ(run, network):
    """What a program of two other sizes differs by from the network, higher than wide and wider than high."""
    clips = [example_inputs(network, size).values() for size in ((38, 20), (18, 30))]
    with torch.no_grad():
        return max(difference(run(*clip), as_exported(network)(*clip)).item() for clip in clips)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "settings"), MADE)
def test_onnx_gives_the_picture_of_the_network(kind, settings, tmp_path, program):
    pytest.importorskip("onnxruntime", reason="the extra export is not installed")
    pytest.importorskip("onnxscript", reason="the extra export is not installed")
    network = unlike_at_first(kind(scale=2, **settings))
    path = tmp_path / "a.onnx"
    export_network(network, path, "onnx")
    assert sizes_differ(program(path), network) < 1e-4
    assert b".py" not in path.read_bytes()  # no paths of the source
    kinds = {node.op_type for node in pytest.importorskip("onnx").load(path).graph.node}
    refused = {"SplitToSequence", "SequenceAt", "Loop", "If", "GatherElements", "ScatterElements"}  # by some engines
    assert not isinstance(network, CSCSR) or not kinds & refused


@pytest.mark.slow
def test_openvino_gives_the_picture_of_the_network(tmp_path):
    openvino = pytest.importorskip("openvino", reason="OpenVINO is not installed")
    pytest.importorskip("onnxscript", reason="the extra export is not installed")
    network = unlike_at_first(CSCSR(scale=2, resolution="sensor", **TINY))
    export_network(network, tmp_path / "a.onnx", "onnx")
    model = openvino.Core().compile_model(tmp_path / "a.onnx", "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    run = lambda *clip: torch.from_numpy(model([one.numpy() for one in clip])[0])  # noqa: E731
    assert sizes_differ(run, network) < 1e-4


def test_inputs_of_an_export(tmp_path):
    film = RecurrentCSCSR(scale=2, **FILM)
    cases = {
        "spikes": CSCSR(scale=2, **TINY, search=False, refinement=False),  # searches nothing, so no motion
        "spikes flow": CSCSR(scale=2, **TINY),
        "spikes flow state every": film,
    }
    for names, network in cases.items():
        assert " ".join(example_inputs(network, (16, 20))) == names
    assert [*example_inputs(film, (16, 20), still=True)] == ["spikes", "state"]
    independent = CSCSR(scale=2, **TINY, motion_fusion="independent")
    assert example_inputs(independent, (16, 20))["flow"].shape == (1, 3, 2, 2, 16, 20)


def test_exported_states_give_the_film_of_the_network():
    network = unlike_at_first(RecurrentCSCSR(scale=2, **FILM))
    generator = torch.Generator().manual_seed(1)
    clips = (torch.rand(1, 3, 41, 16, 20, generator=generator) < 0.3).float()
    flows = torch.randn(1, 3, 2, 2, 16, 20, generator=generator)
    step, state, pictures = as_exported(network), torch.zeros(1, 14, 16, 20), []
    with torch.no_grad():
        for clip, flow in zip(clips.unbind(1), flows.unbind(1), strict=True):
            rgb, state = step(clip, flow, state, torch.tensor(10.0))
            pictures.append(rgb)
        expected = network(clips, flows, every=10)
    torch.testing.assert_close(torch.stack(pictures, dim=1), expected)


@pytest.mark.slow
def test_torch_program_takes_any_even_size(tmp_path, program):
    network = CSCSR(scale=2, resolution="sensor", motion=ClassicalFlow(), **TINY).eval()
    said = export_network(network, tmp_path / "a.pt2", "torch")
    assert said.startswith("takes spikes (1, 41, H, W) and flow (1, 2, 2, H, W), H and W even, within")
    run = program(tmp_path / "a.pt2")
    spikes, flow = (torch.rand(1, 41, 38, 20) < 0.3).float(), 3 * torch.randn(1, 2, 2, 38, 20)
    with torch.no_grad():
        torch.testing.assert_close(run(spikes, flow), network(spikes, flow), rtol=0, atol=1e-4)


def test_export_errors_are_one_line(tmp_path):
    with pytest.raises(ValueError, match=r"CSCSR: cannot be exported \(neighbors, H, W: expected at most 4"):
        export_network(CSCSR(scale=2, neighbors=5, motion=ZeroFlow(), **TINY), tmp_path / "a.pt2", "torch")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_onnxruntime_alone_reconstructs_a_recording(tmp_path, capfd):
    pytest.importorskip("onnxruntime", reason="the extra export is not installed")
    pytest.importorskip("onnxscript", reason="the extra export is not installed")
    network = CSCSR(scale=2, resolution="sensor", motion=ClassicalFlow(), **TINY).eval()
    export_network(network, tmp_path / "a.onnx", "onnx")
    assert capfd.readouterr() == ("", "")
    spikes = torch.rand(41, 16, 24) < 0.3
    write_spikes(tmp_path / "a.dat", spikes)
    command = [sys.executable, "-c", ALONE, *(str(tmp_path / name) for name in ("a.onnx", "a.dat", "a.npy"))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    with torch.no_grad():
        expected = network(spikes[None].float(), torch.full((1, 2, 2, 16, 24), 0.5))
    assert np.abs(np.load(tmp_path / "a.npy") - expected.numpy()).max() < 1e-4
