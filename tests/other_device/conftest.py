"""The cases are for the processes that test_other_device.py starts."""

collect_ignore = ["networks.py", "operators.py", "pretend.py"]
