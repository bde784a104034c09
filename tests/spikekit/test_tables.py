import re

from spikekit.tables import table


def test_cells_are_not_reformatted():
    lines = table(["", "PSNR | dB"], [["one\ntwo", "1.50"], ["", None], [3, "1e3"]]).splitlines()
    assert len(set(map(len, lines))) == 1  # aligned
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines if "---" not in line]
    assert cells == [["", "PSNR \\| dB"], ["one two", "1.50"], ["", ""], ["3", "1e3"]]
    assert set(lines[1]) == {"|", "-"}
