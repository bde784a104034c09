"""What pyproject.toml cannot say: the configurations, beside the packages in a clone, are inside one when installed."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["spikekit*", "lightning_modules*"]), "lightning_modules.configs"],
    package_dir={"lightning_modules.configs": "configs"},
)
