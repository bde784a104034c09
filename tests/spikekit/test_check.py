"""The checks shared by all operators, at the limits of what they accept."""

import numpy as np
import pytest
import torch

from spikekit.check import check_dtype, check_index, check_picture, check_positive, check_whole


@pytest.mark.parametrize(
    ("check", "good", "wrong"),
    [
        (check_positive, (1e-300, 5, np.float32(2)), (0, -1.0, float("inf"), float("nan"), "1", [1.0], 1j, np.ones(2))),
        (check_whole, (1, np.int64(3), np.uint8(1)), (0, -1, 1.5, True, "1", None)),
        (check_index, (0, -1, np.int64(3), torch.tensor(3)), (1.0, "1", None)),
        (check_picture, (torch.ones(3, 4, 5),), (torch.ones(1, 4, 5), torch.ones(1, 3, 4, 5), torch.ones(3, 0, 5))),
        (check_picture, (), (torch.ones(3, 4, 5).byte(), np.ones((3, 4, 5)))),
    ],
)
def test_good_and_wrong_values(check, good, wrong):
    for value in good:
        check("name", value)
    for value in wrong:
        with pytest.raises((ValueError, TypeError), match=r"^name: expected .*got ") as refused:
            check("name", value)
        assert "\n" not in str(refused.value)


def test_only_given_types_of_results_are_accepted():
    for good in (None, torch.float16, torch.uint8):
        check_dtype(good, torch.uint8)
    for wrong in (torch.int16, torch.bool, "uint8", float):
        with pytest.raises(TypeError, match="dtype: expected"):
            check_dtype(wrong, torch.uint8)
