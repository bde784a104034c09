"""Results that the paper reports: the ablations of CSCSR (Table 3) and the methods it compares with (Table 2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

# Dong et al., CVPR 2024, Table 3, a row a scale.
_TABLE_3 = """
     A     B     C     D     E     F     G     H     I     J
2  33.04 33.17 32.05 33.22 30.24 32.66 33.07 30.19 33.24 33.39
3  29.57 29.74 28.19 29.55 27.08 29.42 29.70 27.36 29.69 29.92
4  28.57 28.68 28.06 28.59 26.66 28.39 28.56 26.22 28.66 28.77
"""

# Table 2: PSNR, SSIM and LPIPS on REDS, on Vid4 and, at x4, on Vimeo. TFP+TSCNN has the same scores on REDS at x3 and
# x4, and at x4 on Vid4 the same as TFI+Real-RawVSR: one of each must be a slip of the paper's.
_TABLE_2 = """
2 TFI+TSCNN        29.24 0.8173 0.3126  25.06 0.7786 0.3196
2 TFP+TSCNN        27.43 0.7565 0.3671  24.60 0.7666 0.3142
2 TFI+Real-RawVSR  31.03 0.8627 0.2478  26.79 0.8422 0.2508
2 TFP+Real-RawVSR  30.81 0.8535 0.2601  27.10 0.8564 0.2329
2 3DRI+SwinIR      31.13 0.8809 0.2191  26.57 0.8668 0.2100
2 3DRI+BasicVSR    31.60 0.8912 0.2052  27.03 0.8748 0.2021
2 VidarSR          30.81 0.8991 0.1884  26.44 0.8911 0.1791
2 VidarSR*         30.27 0.8430 0.2631  25.28 0.8106 0.2538
2 SpikeSR-Net      32.38 0.8913 0.2099  28.34 0.8957 0.1833
2 SpikeSR-Net*     29.66 0.8249 0.2861  24.62 0.7854 0.2721
2 CSCSR            33.39 0.9121 0.1764  28.77 0.9110 0.1612
3 TFI+TSCNN        27.22 0.7505 0.3842  22.91 0.6609 0.4058
3 TFP+TSCNN        26.55 0.7176 0.4137  23.22 0.6800 0.3808
3 TFI+Real-RawVSR  28.68 0.7942 0.3292  24.00 0.7225 0.3474
3 TFP+Real-RawVSR  28.66 0.7883 0.3344  24.39 0.7407 0.3326
3 3DRI+SwinIR      28.38 0.8136 0.2977  23.97 0.7534 0.3160
3 3DRI+BasicVSR    28.65 0.8208 0.2905  24.08 0.7568 0.3135
3 VidarSR          29.36 0.8414 0.2679  24.66 0.8009 0.2816
3 VidarSR*         27.53 0.7670 0.3554  22.78 0.6742 0.3680
3 SpikeSR-Net      29.79 0.8270 0.2970  25.33 0.7915 0.2989
3 SpikeSR-Net*     26.73 0.7367 0.3908  22.12 0.6323 0.4067
3 CSCSR            29.92 0.8513 0.2653  25.68 0.8240 0.2761
4 TFI+TSCNN        25.98 0.7010 0.4310  21.69 0.5722 0.4659  24.77 0.7304 0.3554
4 TFP+TSCNN        26.55 0.7176 0.4137  22.53 0.6240 0.4177  25.56 0.7587 0.3557
4 TFI+Real-RawVSR  27.27 0.7391 0.3851  22.53 0.6240 0.4177  25.12 0.7492 0.3244
4 TFP+Real-RawVSR  27.32 0.7347 0.3885  22.81 0.6408 0.3634  25.15 0.7493 0.3324
4 3DRI+SwinIR      26.94 0.7544 0.3602  22.47 0.6533 0.3901  25.21 0.7423 0.3218
4 3DRI+BasicVSR    26.94 0.7570 0.3605  22.52 0.6507 0.3973  25.05 0.7401 0.3204
4 VidarSR          27.56 0.7692 0.3505  22.69 0.6712 0.3868  25.19 0.7565 0.3098
4 VidarSR*         26.51 0.7135 0.4135  21.58 0.5880 0.4395  24.64 0.7352 0.3423
4 SpikeSR-Net      28.28 0.7755 0.3517  23.59 0.6983 0.3727  25.27 0.7611 0.3119
4 SpikeSR-Net*     25.93 0.6913 0.4403  21.01 0.5451 0.4718  24.46 0.7240 0.3593
4 CSCSR            28.77 0.7963 0.3253  23.79 0.7223 0.3555  25.34 0.7660 0.2967
"""

_letters, *_rows = (line.split() for line in _TABLE_3.strip().splitlines())

#: PSNR (dB) on REDS, by scale and variant.
TABLE_3 = {int(scale): dict(zip(_letters, map(float, row), strict=True)) for scale, *row in _rows}


class Scores(NamedTuple):
    """PSNR (dB), SSIM and LPIPS."""

    psnr: float
    ssim: float
    lpips: float

    def __str__(self) -> str:
        return f"{self.psnr:.2f} / {self.ssim:.4f} / {self.lpips:.4f}"


#: scores by scale, method and data set.
TABLE_2: dict[int, dict[str, dict[str, Scores]]] = {}
for _scale, _method, *_values in (line.split() for line in _TABLE_2.strip().splitlines()):
    _found = [Scores(*map(float, _values[n : n + 3])) for n in range(0, len(_values), 3)]
    TABLE_2.setdefault(int(_scale), {})[_method] = dict(zip(("REDS", "Vid4", "Vimeo"), _found, strict=False))

#: what the paper calls a network; where it has several rows of it, its settings say which
_METHODS = {
    "TSCNN": "{decoder}+TSCNN",
    "RealRawVSR": "{decoder}+Real-RawVSR",
    "SwinIR": "3DRI+SwinIR",
    "BasicVSR": "3DRI+BasicVSR",
    "VidarSR": "VidarSR{star}",
    "SpikeSRNetLike": "SpikeSR-Net{star}",
    "CSCSR": "CSCSR",
}


def method_of(network: Mapping[str, Any]) -> str | None:
    """Return what Table 2 calls a network, None where it has no row of it.

    Args:
        network: its settings, with its class, as checkpoints remember them.

    Example:
        >>> method_of({"class": "RealRawVSR", "decoder": "tfp"}), method_of({"class": "VidarSR", "per_channel": True})
        ('TFP+Real-RawVSR', 'VidarSR*')
    """
    name = _METHODS.get(network.get("class", ""))
    star = "*" if network.get("per_channel") else ""
    return name and name.format(decoder=str(network.get("decoder")).upper(), star=star)
