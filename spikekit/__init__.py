"""spikekit: differentiable operators for the colour spike camera."""

from spikekit.cameras import CAMERAS, Camera, camera
from spikekit.cfa import (
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
from spikekit.decoders import SpikeInterval, Tfi, Tfp, spike_interval, tfi, tfp
from spikekit.demosaic import Demosaic, demosaic
from spikekit.files import SpikeFileError, iter_spikes, read_spikes, spikes_shape, write_spikes
from spikekit.film import Film, FilmClip
from spikekit.interpolate import Between, Blend, FlowInterpolation, Still
from spikekit.keyframe import spike_interval_at, tfi_at, tfp_at
from spikekit.metrics import psnr, ssim
from spikekit.motion import JointFlow, LinearMotion, UpsampleFlow, joint_flow, linear_motion, upsample_flow
from spikekit.noise import SensorNoise, SpikeChange
from spikekit.packing import pack_spikes, unpack_spikes
from spikekit.pictures import flow_to_rgb, panel, read_picture, write_picture
from spikekit.plan import Plan, SceneProfile
from spikekit.scene import Layer, Motion, Scene
from spikekit.sensor import SpikeIntegrateFire, spike_integrate_fire
from spikekit.simulate import SpikeSensor, simulate_spikes
from spikekit.streams import decode_in_chunks
from spikekit.video import VideoError, VideoFrames, read_video
from spikekit.warp import FlowWarp, FlowWarpIdw, flow_warp, flow_warp_idw

__version__ = "0.1.0.dev0"

__all__ = [
    "CAMERAS",
    "PATTERNS",
    "BayerMask",
    "Between",
    "BinToSensor",
    "Blend",
    "Camera",
    "Demosaic",
    "Film",
    "FilmClip",
    "FlowInterpolation",
    "FlowWarp",
    "FlowWarpIdw",
    "JointFlow",
    "Layer",
    "LinearMotion",
    "MergeBayer",
    "Mosaic",
    "Motion",
    "Plan",
    "Scene",
    "SceneProfile",
    "SensorNoise",
    "SpikeChange",
    "SpikeFileError",
    "SpikeIntegrateFire",
    "SpikeInterval",
    "SpikeSensor",
    "SplitBayer",
    "SplitColors",
    "Still",
    "Tfi",
    "Tfp",
    "UpsampleFlow",
    "VideoError",
    "VideoFrames",
    "bayer_mask",
    "bayer_pattern",
    "bayer_sites",
    "bin_to_sensor",
    "camera",
    "decode_in_chunks",
    "demosaic",
    "flow_to_rgb",
    "flow_warp",
    "flow_warp_idw",
    "iter_spikes",
    "joint_flow",
    "linear_motion",
    "merge_bayer",
    "mosaic",
    "pack_spikes",
    "panel",
    "psnr",
    "read_picture",
    "read_spikes",
    "read_video",
    "simulate_spikes",
    "spike_integrate_fire",
    "spike_interval",
    "spike_interval_at",
    "spikes_shape",
    "split_bayer",
    "split_colors",
    "ssim",
    "tfi",
    "tfi_at",
    "tfp",
    "tfp_at",
    "unpack_spikes",
    "upsample_flow",
    "write_picture",
    "write_spikes",
]
