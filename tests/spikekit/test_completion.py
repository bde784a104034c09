"""Tab completion, as bash does it."""

import shutil
import subprocess
import sys

import pytest

from spikekit.cli.command import main

PRESSED = """
source "$1"
COMP_WORDS=("${@:2}") COMP_CWORD=$(($# - 2))
_shtab_${COMP_WORDS[0]}
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module", name="pressed")
def _pressed(tmp_path_factory):
    """Return what bash offers for the last of some words."""
    pytest.importorskip("shtab", reason="shtab is not installed")
    if shutil.which("bash") is None:
        pytest.skip("there is no bash")
    folder = tmp_path_factory.mktemp("completion")
    (folder / "clip.dat").touch()
    modules = {"spikekit": "spikekit", "lightning": "lightning_modules"}

    def press(*words):
        script = folder / f"{words[0]}.bash"
        if not script.exists():
            line = [sys.executable, "-m", modules[words[0]], "--print-completion", "bash"]
            script.write_text(subprocess.run(line, capture_output=True, text=True, check=True, timeout=600).stdout)
        line = ["bash", "-c", PRESSED, "bash", str(script), *words]
        return subprocess.run(line, capture_output=True, text=True, check=True, cwd=folder).stdout.split()

    return press


def test_verbs_options_choices_and_files(pressed):
    assert pressed("spikekit", "de") == ["decode"]
    assert pressed("spikekit", "decode", "--met") == ["--method"]
    assert pressed("spikekit", "decode", "--method", "") == ["tfi", "tfp"]
    assert pressed("spikekit", "decode", "cl") == ["clip.dat"]


@pytest.mark.slow
def test_options_of_lightning_and_of_what_they_name(pressed):
    assert {"fit", "predict", "export", "models"} <= {*pressed("lightning", "")}
    assert pressed("lightning", "predict", "--pat") == ["--pattern"]
    assert pressed("lightning", "predict", "--speed", "fast") == ["fastest", "fast"]
    assert pressed("lightning", "predict", "cl") == ["clip.dat"]
    assert pressed("lightning", "export", "--for") == ["--format"]


@pytest.mark.parametrize(("shell", "said"), [([], "got none"), (["ksh"], "got ksh")])
def test_what_is_no_shell(shell, said, capsys):
    pytest.importorskip("shtab", reason="shtab is not installed")
    assert main(["--print-completion", *shell]) == 2
    assert said in capsys.readouterr().err


def test_without_shtab_a_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["--print-completion", "bash"]) == 2
    assert capsys.readouterr().err == "spikekit: --print-completion: expected shtab, pip install shtab brings it\n"
