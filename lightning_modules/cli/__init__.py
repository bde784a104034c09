"""The ``lightning`` command."""

from spikekit._renamed import moved

# by name, as the modules import this package
__getattr__ = moved(
    __name__,
    {
        "CHOICES": "lightning_modules.cli.command",
        "Command": "lightning_modules.cli.command",
        "InputError": "lightning_modules.cli.errors",
        "Parser": "lightning_modules.cli.command",
        "check_folder": "lightning_modules.cli.command",
        "main": "lightning_modules.__main__",
        "run": "lightning_modules.cli.command",
    },
)
