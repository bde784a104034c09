"""Recordings, side-cars, cameras, pictures and videos in files."""

from spikekit.io.cameras import CAMERAS, Camera, camera
from spikekit.io.files import SpikeFileError, iter_spikes, read_spikes, spikes_shape, write_spikes
from spikekit.io.images import PictureError, flow_to_rgb, panel, read_picture, write_picture
from spikekit.io.video import VideoError, VideoFrames, read_video
from spikekit.io.video_output import write_video

__all__ = [
    "CAMERAS",
    "Camera",
    "PictureError",
    "SpikeFileError",
    "VideoError",
    "VideoFrames",
    "camera",
    "flow_to_rgb",
    "iter_spikes",
    "panel",
    "read_picture",
    "read_spikes",
    "read_video",
    "spikes_shape",
    "write_picture",
    "write_spikes",
    "write_video",
]
