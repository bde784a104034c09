"""Networks, data and commands that learn from colour spike streams, built on spikekit."""
