"""LightningModules: super-resolution and optical flow."""

from lightning_modules.quick_import import import_lightning

import_lightning()
