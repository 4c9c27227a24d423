"""The queue of a voice in a page, in a browser without sound: how late it plays, and when it stalls."""

import pytest

from vinesim.web.page_files import PAGE

FRAME = 960
QUANTUM = 128
"""Samples of a frame and of what the browser plays at once."""
START = FRAME // 2
"""Delay of a voice behind the arrival of its first frame [samples]."""
PLAY = """
(sentences) => {
  const made = {};
  class AudioWorkletProcessor { constructor() { this.port = { postMessage() {} }; } }
  const registerProcessor = (name, made_) => { made[name] = made_; };
  const currentFrame = 0, sampleRate = 48000;
  %s
  const player = new made.player(), delays = [];
  for (const late of sentences) {
    // frames that begin 20 ms apart, each so many samples late; the last five are silence, then a pause follows
    const due = late.map((samples, k) => 960 * k + samples);
    let sent = 0, heard = null;
    for (let now = 0; now < 960 * (late.length + 30); now += 128) {
      for (; sent < due.length && due[sent] <= now; ++sent)
        player.port.onmessage({ data: new Float32Array(960).fill(sent < late.length - 5 ? 0.5 : 0) });
      const out = new Float32Array(128);
      player.process([], [[out]]);
      if (heard === null && out.some((value) => value > 0.1)) heard = now;
    }
    delays.push(heard);
  }
  return { delays, stalls: player.counts.stalls };
}
"""
"""Delays at which sentences begin to be heard [samples] and stalls, of frames that are late by so many samples."""


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_voice_waits_longer_after_stalls_and_no_longer_than_needed_once_its_network_is_quick_again(page):
    script = PLAY % (PAGE / "voice_worklet.js").read_text()

    def play(*sentences):
        return page.run(f"({script})({[list(one) for one in sentences]})")

    even = [0] * 20
    rough = [0, 0, 0, 3 * FRAME, 2 * FRAME, FRAME] + [0] * 14
    smooth = play(even, even, even)
    assert smooth["stalls"] == 0
    assert max(smooth["delays"]) <= START + 2 * QUANTUM, "half a frame after the first one has come"

    bad = play(*[rough] * 12)
    assert 0 < bad["stalls"] < 12, "it has learned to wait"
    assert bad["delays"][-1] > 2 * FRAME

    after = play(*[rough] * 12, *[even] * 24)
    assert after["stalls"] == bad["stalls"], "no new ones"
    assert after["delays"][11] == bad["delays"][11]
    assert after["delays"][-1] <= START + 2 * QUANTUM, "as early as before"
