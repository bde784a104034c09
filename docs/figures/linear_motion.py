"""Two flows of the middle frame, and where linear motion puts its pixels at other times."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

times = list(range(5, 36, 3))
first, middle, last = times[0], 20, times[-1]
to_first = torch.tensor([-6.0, 1.0]).reshape(2, 1, 1)
to_last = torch.tensor([3.0, 4.0]).reshape(2, 1, 1)
offset = sk.linear_motion(to_first, to_last, times)[:, :, 0, 0]  # (11, 2)

figure, (path, course) = plt.subplots(1, 2, figsize=(7.2, 3), layout="constrained")
for flow, name in ((to_first, "flow_to_first"), (to_last, "flow_to_last")):
    u, v = flow.flatten().tolist()
    path.annotate("", (u, v), (0, 0), arrowprops={"arrowstyle": "->", "color": "0.6", "lw": 2})
    path.text(u, v + 0.5, name, ha="center", va="top", color="0.4")
dots = path.scatter(*offset.T, c=times, cmap="coolwarm", zorder=2)
figure.colorbar(dots, ax=path, label="time", shrink=0.8)
path.set(xlabel="x offset (pixels)", ylabel="y offset", aspect="equal", xlim=(-10, 7), ylim=(6, -2), title="path")
for axis, name in enumerate("xy"):
    course.plot(times, offset[:, axis], "o-", markersize=4, label=name)
course.plot([first, middle, last], [to_first[0].item(), 0, to_last[0].item()], "ks", fillstyle="none")
course.plot([first, middle, last], [to_first[1].item(), 0, to_last[1].item()], "ks", fillstyle="none")
course.set(xlabel="time", ylabel="offset (pixels)", xticks=[first, middle, last], title="course")
course.grid(color="0.9")
course.legend()
