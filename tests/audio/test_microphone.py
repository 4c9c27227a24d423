"""A microphone records the sum of what is near it, by the law of loudness, also when frames are lost or late."""

import base64
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.audio import hearing, opus
from vinesim.audio.frame import FRAME, FRAME_SAMPLES, SAMPLE_RATE, Codec, find_fault, from_pcm, to_pcm
from vinesim.audio.hearing import SpectatorsSpeakTo, may_hear
from vinesim.audio.loudspeaker import MAX_QUEUED, Loudspeaker
from vinesim.audio.microphone import DELAY, MAX_DELAY, HeardFrame, Microphone

START = 100.0


def tone(frequency, seconds=1.0, amplitude=0.5):
    return amplitude * np.sin(2.0 * np.pi * frequency * np.arange(round(seconds * SAMPLE_RATE)) / SAMPLE_RATE)


def frames_of(samples, speaker="anna", gain=1.0, start=START):
    for number in range(len(samples) // FRAME_SAMPLES):
        part = samples[number * FRAME_SAMPLES : (number + 1) * FRAME_SAMPLES]
        yield HeardFrame(speaker, number, start + number * FRAME, Codec.PCM16, to_pcm(part), gain)


def record(microphone, *voices, seconds=1.0, lateness=0.0):
    """What is recorded when each frame arrives as soon as it is over, and so much later [s]."""
    frames = sorted((frame for voice in voices for frame in voice), key=lambda frame: frame.time)
    blocks = [*microphone.blocks(START)]
    now = START
    while now < START + seconds + MAX_DELAY:
        while frames and frames[0].time + FRAME + lateness <= now + 1e-9:
            microphone.hear(frames.pop(0))
        blocks += microphone.blocks(now)
        now += 0.01
    times = np.array([block.time for block in blocks])
    np.testing.assert_allclose(np.diff(times), FRAME, atol=1e-9)
    samples = np.concatenate([block.samples for block in blocks])
    first = round((START - times[0]) * SAMPLE_RATE)
    return samples[first : first + round(seconds * SAMPLE_RATE)]


def amplitude(samples, frequency):
    time = np.arange(len(samples)) / SAMPLE_RATE
    return 2.0 * abs(np.mean(samples * np.exp(-2j * np.pi * frequency * time)))


def test_loudness_falls_by_the_distance_and_ends():
    distances = np.linspace(0.0, 40.0, 4001)
    gains = np.array([hearing.gain(d) for d in distances])
    assert (np.diff(gains) <= 0.0).all()
    assert gains[0] == hearing.gain(1.0) == 1.0
    assert hearing.gain(2.0) / hearing.gain(10.0) == pytest.approx(5.0)
    assert (gains[distances >= hearing.REACH] == 0.0).all()
    assert hearing.gain(np.nan) == 0.0
    assert np.abs(np.diff(gains)).max() < 0.011, "no step anywhere"


def test_a_voice_is_recorded_as_it_was_said():
    said = tone(440.0)
    heard = record(Microphone(), frames_of(said))
    np.testing.assert_allclose(heard, said, atol=1e-4)


def test_voices_add_up_each_by_its_loudness():
    near = tone(440.0)
    far = tone(700.0)
    heard = record(Microphone(), frames_of(near, "anna", hearing.gain(2.0)), frames_of(far, "ben", hearing.gain(10.0)))
    assert amplitude(heard, 440.0) == pytest.approx(0.25, abs=1e-3)
    assert amplitude(heard, 700.0) == pytest.approx(0.05, abs=1e-3)


def test_a_lost_frame_is_filled_and_counted():
    microphone = Microphone()
    said = tone(440.0)
    kept = [frame for frame in frames_of(said) if frame.number != 20]
    heard = record(microphone, kept)
    hole = slice(20 * FRAME_SAMPLES, 21 * FRAME_SAMPLES)
    assert microphone.lost == 1
    assert np.abs(heard[hole]).max() > 0.2, "not silence"
    np.testing.assert_allclose(np.delete(heard, np.r_[hole]), np.delete(said, np.r_[hole]), atol=1e-4)


def test_frames_that_come_too_late_are_counted_and_the_delay_grows_until_they_are_in_time():
    microphone = Microphone()
    heard = record(microphone, frames_of(tone(440.0, 3.0)), seconds=3.0, lateness=DELAY + 0.07)
    assert 0 < microphone.late < 20
    assert DELAY < microphone.delay <= MAX_DELAY
    assert amplitude(heard[-SAMPLE_RATE:], 440.0) == pytest.approx(0.5, abs=0.01)


def test_what_is_no_sound_is_counted_and_nothing_else_suffers():
    microphone = Microphone()
    said = tone(440.0)
    noise = [HeardFrame("evil", n, START + n * FRAME, Codec.OPUS, bytes((8, n, 255 - n)), 1.0) for n in range(40)]
    far_off = [HeardFrame("clock", n, START + 1e6 * (n - 20), Codec.PCM16, bytes(640), 1.0) for n in range(40)]
    heard = record(microphone, frames_of(said), noise, far_off)
    assert np.isfinite(heard).all()
    assert amplitude(heard, 440.0) > 0.3


def test_the_tone_of_lights_begins_and_ends_without_a_click():
    microphone = Microphone()
    now = START
    blocks = []
    blocks += microphone.blocks(now)
    for step in range(100):
        lit = step % 50 < 25
        microphone.sound("robot", 1500.0 if lit else 0.0, 0.5 if lit else 0.0, now)
        blocks += microphone.blocks(now)
        now += 0.01
    samples = np.concatenate([block.samples for block in blocks])
    level = np.abs(samples).reshape(-1, 160).max(1)
    assert (level > 0.45).sum() > 40
    assert (level < 1e-6).sum() > 30
    assert np.abs(np.diff(samples)).max() < 1.05 * 0.5 * 2.0 * np.pi * 1500.0 / SAMPLE_RATE


def test_after_the_clock_was_set_it_goes_on():
    microphone = Microphone()
    list(microphone.blocks(START))
    for now in (START + 0.1, START - 50.0, START + 1e6):
        list(microphone.blocks(now))
        later = list(itertools.islice(microphone.blocks(now + 0.1), 10))
        assert 4 <= len(later) <= 6
        assert abs(later[-1].time - (now + 0.1)) < 0.1


@given(st.integers(0, 255), st.binary(max_size=900))
def test_what_passes_as_a_frame_can_be_recorded(codec, data):
    if find_fault(codec, data):
        return
    microphone = Microphone()
    list(microphone.blocks(START))
    microphone.hear(HeardFrame("anna", 0, START, Codec(codec), data, 1.0))
    assert all(np.isfinite(block.samples).all() for block in microphone.blocks(START + 0.3))


def test_opus_of_a_browser_is_decoded():
    """Packets of 20 ms of a tone of 440 Hz, if PyAV is installed; else each is counted."""
    microphone = Microphone()
    frames = [
        HeardFrame("anna", number, START + number * FRAME, Codec.OPUS, packet, 1.0)
        for number, packet in enumerate(PACKETS)
    ]
    heard = record(microphone, frames, seconds=len(PACKETS) * FRAME)
    if not opus.is_available():
        assert microphone.undecoded == len(PACKETS)
        return
    assert microphone.undecoded == 0
    assert amplitude(heard[-3200:], 440.0) == pytest.approx(0.25, rel=0.15)


def test_a_loudspeaker_plays_messages_of_any_length_without_gaps():
    said = to_pcm(tone(300.0))
    loudspeaker = Loudspeaker()
    now = START
    played = []
    parts = [said[at : at + 1026] for at in range(0, len(said), 1026)]  # 32 ms and a sample
    due = START
    for _ in range(200):
        while parts and due <= now:
            loudspeaker.play(parts.pop(0))
            due += 513 / SAMPLE_RATE
        played += loudspeaker.frames(now)
        now += 0.01
    times = np.array([time for time, _ in played])
    np.testing.assert_allclose(np.diff(times), FRAME, atol=1e-9)
    sound = b"".join(data for _, data in played)
    assert sound[: len(said)] == said
    assert not any(sound[len(said) :])
    assert len(sound) - len(said) < 640


def test_a_loudspeaker_keeps_no_more_than_it_should():
    loudspeaker = Loudspeaker()
    for _ in range(40):
        loudspeaker.play(bytes(2 * SAMPLE_RATE))
    assert loudspeaker.refused == pytest.approx((40.0 - MAX_QUEUED) * 2 * SAMPLE_RATE, abs=1000)
    assert len(list(loudspeaker.frames(START))) == 1


def test_pcm_keeps_its_values_and_clips():
    np.testing.assert_allclose(from_pcm(to_pcm(np.array([0.0, 0.5, -1.0, 3.0]))), [0.0, 0.5, -1.0, 1.0], atol=2e-5)


@pytest.mark.parametrize(
    ("setting", "heard_by"),
    [("nobody", set()), ("people", {"human", "spectator"}), ("all", {"human", "spectator", "robot"})],
)
def test_who_hears_spectators(setting, heard_by):
    kinds = ("human", "spectator", "robot")
    assert {kind for kind in kinds if may_hear("spectator", kind, SpectatorsSpeakTo(setting))} == heard_by
    assert all(may_hear(speaker, kind, SpectatorsSpeakTo(setting)) for speaker in ("human", "robot") for kind in kinds)


def unpack(text):
    """Packets, each behind a byte with its length."""
    data = base64.b85decode(text)
    while data:
        yield data[1 : 1 + data[0]]
        data = data[1 + data[0] :]


PACKETS = list(
    unpack(
        "HAsTuw`^9o^Z)_`yT0Coc88)j39$Hl_D1JGGlpIIw|3*5(jlmxv1jr9*pcy*`M@l9esC;Es(znW<0-"
        "t7rJ<NzWl83exXD|U>uHw)5q_<jgaqn5hy7q__PxU80)~JpNT2z+WnSKsq&7gq!f)Od|2IYuk8`=Gzh!4k+xGrJTaBxhqS!(h@qjHzpZU3XT"
        "!>dS8A}I>Cz?+9Z3I-"
        "VWMI3ELsp!lNN?+40Ei4_ds>B<GJHY6FG!#Hx4aj>DNQ9m0LJhWigfHLA{c3|35T4(e7pg_3@qNT(tafK7;Pig7{nl!E=ZsGxp-"
        "WR6EVJAyt$}Tdrto1F-7-{kTtbC2vEzR^aM!hmtwn>K8BCqX}Rz*NT2z)ycfVLek55I;nXUi5JT)kQb-LAHQDS{!mG1wMCZYqF|koPz<;4bn"
        "OJ&#*d|Dy`MG#pi{o<u@un%`Sx$Gv|B<Eqh<C~Jvb2F3gnBA<Bw6~JC`h3~8F*ZXS0K)r8P`(HY9<&dk0FV1(5_(rhK4iiJp+7vKbf#ia4tx"
        "pLK%2mh%iL5oNO_~obq8N>1>OJ|C<01NQin`ZM&Q;?l0@mjX~%UJcruXC`h3~Crf^bI*`L3qiHFawRgjb9CkH}MT!4B1P&R(_5LI=F>1xdfG"
        "9|zLhKM((qTdOf^JJ1{E7V`!9jG`l3hHKOQcCzHJA}<g-Zt_rX(y#p+XsDUf#`)a+`6k!~RdSBOLJ=^F(C%*L|qWx+JSn7Tt!Fb-"
        "&iGK#YJXNTEU*cwC5CLG~2xt-iP=lEHt7FE{q|&)YTSv&^3XhAr$*mMQ!05GhEZsQz=NP6fI~T;Wl?%%`bbI{uqRW_v$LV3tz-"
        "9>O(lqKF}QL-m#>NTP~|OMZz$yAiH?5orLCVSmeB=gHR}ujme14;j(~4$<Pv-"
        "1IC+qKbKVT!>njr0?t%JaB9+eNoZU?XVBEs}NL5tcI>*yz!7;ApeL~wOz$BNTP~)cwCGWc{((MO!hpuon8#^Lr&gE<B^I`tnLQ;B*ncfeQ?i"
        "Wt6=lfi`X#hPQWNgqte-"
        "UT!J`_?JwbIm~VouSWfPM+@x4)K>P6lY|;RDl<XY#vz*E)NTbr(cwB-2l?E9=@F;t6HNpz&{sFLx@?;}h6uPhGVJjOL;S7f`Km"
    )
)
"""Of libopus at 12 kbit/s: 440 Hz with the amplitude 0.25."""
