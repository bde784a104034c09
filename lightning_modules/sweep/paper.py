"""What the paper reports for the variants of CSCSR."""

# Dong et al., CVPR 2024, Table 3, a row a scale.
_TABLE_3 = """
     A     B     C     D     E     F     G     H     I     J
2  33.04 33.17 32.05 33.22 30.24 32.66 33.07 30.19 33.24 33.39
3  29.57 29.74 28.19 29.55 27.08 29.42 29.70 27.36 29.69 29.92
4  28.57 28.68 28.06 28.59 26.66 28.39 28.56 26.22 28.66 28.77
"""

_letters, *_rows = (line.split() for line in _TABLE_3.strip().splitlines())

#: PSNR (dB) on REDS, by scale and variant.
TABLE_3 = {int(scale): dict(zip(_letters, map(float, row), strict=True)) for scale, *row in _rows}
