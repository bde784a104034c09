"""Pictures of 16 bits that no library writes alone: TIFFs packed by LZW."""

import io

import tifffile
from PIL import Image


def write_lzw_tiff(path, pixels, **how):
    """Write (H, W, C) uint16: Pillow packs the bytes, tifffile says what they are."""
    packed = io.BytesIO()
    Image.fromarray(pixels.astype("<u2").reshape(1, -1).view("u1")).save(packed, "TIFF", compression="tiff_lzw")
    packed.seek(0)
    with tifffile.TiffFile(packed) as file:
        (start,), (length,) = file.pages.first.dataoffsets, file.pages.first.databytecounts
    strip = packed.getvalue()[start : start + length]
    how = {"photometric": "rgb", "compression": "zlib", "byteorder": "<"} | how
    tifffile.imwrite(path, iter([strip]), shape=pixels.shape, dtype="uint16", **how)
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags["Compression"].overwrite(5)
