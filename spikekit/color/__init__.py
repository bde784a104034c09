"""The colour filter array and demosaicing."""

from spikekit.color.cfa import (
    PATTERNS,
    BayerMask,
    BinToSensor,
    MergeBayer,
    Mosaic,
    SplitBayer,
    SplitColors,
    bayer_mask,
    bayer_pattern,
    bayer_sites,
    bin_to_sensor,
    merge_bayer,
    mosaic,
    split_bayer,
    split_colors,
)
from spikekit.color.demosaic import Demosaic, demosaic
from spikekit.color.residual_demosaic import DemosaicResidual, demosaic_residual

__all__ = [
    "PATTERNS",
    "BayerMask",
    "BinToSensor",
    "Demosaic",
    "DemosaicResidual",
    "MergeBayer",
    "Mosaic",
    "SplitBayer",
    "SplitColors",
    "bayer_mask",
    "bayer_pattern",
    "bayer_sites",
    "bin_to_sensor",
    "demosaic",
    "demosaic_residual",
    "merge_bayer",
    "mosaic",
    "split_bayer",
    "split_colors",
]
