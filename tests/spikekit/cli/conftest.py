import pytest

from spikekit.cli.command import main


@pytest.fixture(name="fails")
def _fails(capsys):
    """Run a command line that must fail with one line on stderr and nothing on stdout."""

    def check(status, *words):
        capsys.readouterr()
        assert main([str(word) for word in words]) == status
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("spikekit: ")
        assert err.endswith("\n")
        assert err.count("\n") == 1
        return err

    return check
