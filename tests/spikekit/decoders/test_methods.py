"""The table of decoders: each is one decoder, whichever way it is called."""

import pytest
import torch

from spikekit.decoders.methods import DECODERS

CASES = [(name, heading, options) for name, decoder in DECODERS.items() for heading, options in decoder.shown.items()]


@pytest.mark.parametrize(("name", "heading", "options"), CASES, ids=[heading for _, heading, _ in CASES])
@pytest.mark.parametrize("frame", [0, 17, 40, 79])
def test_clip_frame_and_planes_agree(name, heading, options, frame):
    decoder = DECODERS[name]
    spikes = (torch.rand(80, 6, 10, generator=torch.Generator().manual_seed(frame)) < 0.3).to(torch.uint8)
    reach = decoder.reach(**options)
    seen = range(max(frame - reach, 0), min(frame + reach, 79) + 1)
    asked = set()

    def plane(n):
        asked.add(n)
        return spikes[n].numpy()

    whole = decoder.clip(spikes, **options)[frame]
    torch.testing.assert_close(decoder.frame(spikes, frame, **options), whole)
    torch.testing.assert_close(torch.from_numpy(decoder.planes(plane, frame, seen, 80, **options)), whole)
    assert asked <= set(seen)
