"""Analytic scenes against a renderer in plain loops, and properties of light, ground truth and flow."""

import math

import numpy as np
import pytest
import torch

from spikekit import bin_to_sensor, upsample_flow
from spikekit.scenes.analytic import Layer, Motion, Scene


def smooth_picture(height, width, dtype=torch.float64):
    """A picture of waves of about twenty pixels, different in each colour."""
    y, x = torch.meshgrid(torch.arange(height, dtype=dtype), torch.arange(width, dtype=dtype), indexing="ij")
    waves = [0.5 + 0.2 * torch.sin(x / a + 1) + 0.2 * torch.cos(y / b + x / 9) for a, b in ((3, 4), (4, 3), (5, 5))]
    return torch.stack(waves)


def busy_scene(height, width, frames=41, dtype=torch.float64, seed=0):
    """A moving, rotating, growing background, mirrored at its border, and two overlapping objects."""
    g = torch.Generator().manual_seed(seed)

    def rand(*size):
        return torch.rand(size, generator=g, dtype=dtype)

    a, b = max(4, height // 2), max(5, width // 2)
    return Scene(
        [
            Layer(rand(3, height - 2, width - 3), Motion((0.21, -0.13), 0.004, 1.003, (width / 2, height / 3)), (2, 1)),
            Layer(rand(3, a, b), Motion((-0.3, 0.11), -0.01, 0.996, (2.0, 3.0)), (-2, 1), rand(a, b).round()),
            Layer(rand(3, b, a), Motion((0.1, 0.4), 0.02, 1.0, (5.0, 1.5), (0.01, -0.02)), (1, 3), rand(b, a)),
        ],
        height,
        width,
        frames,
    )


def bilinear(value, x, y):
    x0, y0 = math.floor(x), math.floor(y)
    corners = [(x0 + i, y0 + j) for i in (0, 1) for j in (0, 1)]
    return sum((1 - abs(x - i)) * (1 - abs(y - j)) * value(i, j) for i, j in corners)


def brute_look(layer, x, y):
    """Return colour and opacity of a layer at a position of its picture."""
    picture = layer.picture.numpy()
    h, w = picture.shape[1:]

    def mirrored(i, j):
        i, j = i % (2 * w), j % (2 * h)
        return picture[:, j if j < h else 2 * h - 1 - j, i if i < w else 2 * w - 1 - i]

    def clamped(i, j):
        return picture[:, min(max(j, 0), h - 1), min(max(i, 0), w - 1)]

    def covered(i, j):
        return float(layer.mask[j, i]) if 0 <= i < w and 0 <= j < h else 0.0

    if layer.mask is None:
        return bilinear(mirrored, x, y), 1.0
    return bilinear(clamped, x, y), bilinear(covered, x, y)


def brute_rgb(scene, clock):
    """Render by the definition, pixel by pixel and layer by layer."""
    tau = clock - scene.frames // 2
    image = np.zeros((3, scene.height, scene.width))
    for layer in scene.layers:
        (cx, cy), (vx, vy), (ax, ay) = layer.motion.center, layer.motion.velocity, layer.motion.acceleration
        along, down = vx * tau + ax * tau**2 / 2, vy * tau + ay * tau**2 / 2
        cos, sin = math.cos(layer.motion.rotation * tau), math.sin(layer.motion.rotation * tau)
        size = layer.motion.zoom**tau
        for row in range(scene.height):
            for column in range(scene.width):
                dx, dy = (column - cx - along) / size, (row - cy - down) / size
                x, y = cx + cos * dx + sin * dy, cy - sin * dx + cos * dy
                colour, much = brute_look(layer, x - layer.position[0], y - layer.position[1])
                image[:, row, column] += much * (colour - image[:, row, column])
    return torch.from_numpy(image)


@pytest.mark.parametrize("clock", [0, 7, 20, 33.5, 40])
def test_pictures_and_flow_equal_those_of_loops(clock):
    scene = busy_scene(12, 17)
    torch.testing.assert_close(scene.rgb(clock), brute_rgb(scene, clock), atol=1e-12, rtol=0)


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
@pytest.mark.parametrize("scale", [1, 3, 4])
def test_light_is_the_binned_view(pattern, scale):
    scene = busy_scene(7 * scale, 10 * scale)  # an odd number of rows: the last Bayer cell is cut
    expected = torch.stack([bin_to_sensor(scene.rgb(t), pattern, scale=scale) for t in range(41)]) * 0.4
    torch.testing.assert_close(scene.light(pattern, scale=scale, alpha=0.4), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("frames", [1, 4, 41])
def test_middle_shows_the_original_pixels(frames):
    g = torch.Generator().manual_seed(3)
    picture, thing = torch.rand(3, 33, 50, generator=g), torch.rand(3, 6, 8, generator=g)
    motion = Motion((0.3, 0.7), 0.01, 1.01, (11.3, 7.7))
    ground = Layer(picture, motion, (-5, -2))
    scene = Scene([ground, Layer(thing, motion, (10, 4), torch.ones(6, 8))], 24, 32, frames)
    expected = picture[:, 2:26, 5:37].clone()
    expected[:, 4:10, 10:18] = thing
    assert torch.equal(scene.rgb(frames // 2), expected)


def test_translation_moves_the_picture_right_and_down():
    picture = torch.rand(3, 40, 40, dtype=torch.float64)
    scene = Scene([Layer(picture, Motion((0.5, 0.25)), (-10, -10))], 20, 20)
    torch.testing.assert_close(scene.rgb(28), picture[:, 8:28, 6:26])
    assert scene.flow(28, scale=1).flatten(1).unique(dim=1).tolist() == [[4.0], [2.0]]
    assert scene.flow(28, scale=4).flatten(1).unique(dim=1).tolist() == [[1.0], [0.5]]


def test_acceleration_bends_the_path():
    scene = Scene([Layer(torch.rand(3, 40, 40), Motion((0.5, 0.0), acceleration=(0.0, 0.25)))], 20, 20)
    flows = [scene.flow(20 + tau, scale=1)[:, 7, 9].tolist() for tau in (-4, 0, 4)]
    assert flows == [[-2.0, 2.0], [0.0, 0.0], [2.0, 2.0]]


def test_rotation_is_clockwise_on_the_screen_and_zoom_grows():
    scene = Scene([Layer(torch.rand(3, 9, 9), Motion(rotation=math.pi / 2 / 20, center=(4, 4)))], 9, 9)
    to_last = scene.flow(40, scale=1)
    torch.testing.assert_close(to_last[:, 4, 8], torch.tensor([-4.0, 4.0]))  # from the right to the bottom
    torch.testing.assert_close(scene.rgb(40), scene.rgb(20).rot90(-1, (1, 2)), atol=1e-5, rtol=0)
    scene = Scene([Layer(torch.rand(3, 9, 9), Motion(zoom=2 ** (1 / 20), center=(4, 4)))], 9, 9)
    torch.testing.assert_close(scene.flow(40, scale=1)[:, 3, 6], torch.tensor([2.0, -1.0]))
    torch.testing.assert_close(scene.flow(0, scale=1)[:, 3, 6], torch.tensor([-1.0, 0.5]))


@pytest.mark.parametrize("scale", [2, 3, 4])
def test_flow_at_the_sensor_is_flow_at_the_centre_of_its_block(scale):
    motion = Motion((0.31, -0.17), 0.01, 0.99, (7.0, 5.0))
    scene = Scene([Layer(smooth_picture(60, 60), motion)], 12 * scale, 8 * scale)
    fine = scene.flow(35, scale=1)
    blocks = torch.nn.functional.avg_pool2d(fine, scale) / scale  # flow of one layer is affine: mean is centre
    coarse = scene.flow(35, scale=scale)
    torch.testing.assert_close(coarse, blocks, atol=1e-9, rtol=0)
    up = upsample_flow(coarse[None], scale)[0]  # the package's own idea of the half-pixel phase
    inner = (slice(None), slice(scale, -scale), slice(scale, -scale))
    torch.testing.assert_close(up[inner], fine[inner], atol=1e-9, rtol=0)


def test_flow_of_the_topmost_object():
    ground = Layer(torch.rand(3, 40, 40), Motion((0.1, 0.0)))
    low = Layer(torch.rand(3, 16, 16), Motion((0.0, 0.2)), (8, 8), torch.ones(16, 16))
    high = Layer(torch.rand(3, 8, 8), Motion((-0.3, 0.0)), (8, 8), torch.ones(8, 8))
    flow = Scene([ground, low, high], 40, 40).flow(30, scale=4) * 4 / 10
    expected = torch.tensor([0.1, 0.0])[:, None, None].repeat(1, 10, 10)
    expected[:, 2:6, 2:6] = torch.tensor([0.0, 0.2])[:, None, None]
    expected[:, 2:4, 2:4] = torch.tensor([-0.3, 0.0])[:, None, None]
    torch.testing.assert_close(flow, expected)


PICTURE = torch.rand(3, 8, 8)


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda: Scene([], 8, 8), ValueError, "layers: expected a background"),
        (lambda: Scene([Layer(PICTURE)] * 2, 8, 8), ValueError, "layers: expected a background"),
        (lambda: Layer(PICTURE, mask=torch.ones(8, 7)), ValueError, r"mask: expected \(8, 8\), got \(8, 7\)"),
        (lambda: Layer(PICTURE[:2]), ValueError, r"picture: expected \(3, h, w\)"),
        (lambda: Layer(PICTURE.half()), TypeError, "float32 or float64"),
        (lambda: Motion(zoom=0.0), ValueError, "zoom: expected"),
        (lambda: Scene([Layer(PICTURE)], 8, 8).light(scale=3), ValueError, "scale: expected a divisor of .* got 3"),
        (lambda: Scene([Layer(PICTURE)], 8, 8, 0), ValueError, "frames: expected at least 1"),
    ],
)
def test_invalid_arguments_are_rejected(make, error, said):
    with pytest.raises(error, match=said):
        make()
