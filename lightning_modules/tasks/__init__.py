"""LightningModules: super-resolution and optical flow."""
