"""The newest value only, across a real process boundary."""

import multiprocessing

import pytest

from vinesim.client.sensing.latest_value import LatestValue, make_poll


def forward_values(latest, pipe):
    """The reader's process: says that it is there, then what it takes, until an empty value."""
    pipe.send("ready")
    while True:
        value = latest.take(5.0)
        if value is not None:
            pipe.send(value)
            if value == b"end":
                return


@pytest.fixture
def context():
    return multiprocessing.get_context("spawn")


def test_the_newest_letter_replaces_what_was_not_read(context):
    latest = LatestValue(100, context)
    try:
        assert latest.take(0.0) is None
        for i in range(5):
            assert latest.put(b"value %d" % i)
        reader = LatestValue.__new__(LatestValue)
        reader.__dict__.update(latest.__getstate__())
        assert reader.take(0.0) == b"value 4"
        assert reader.take(0.0) is None
    finally:
        latest.close()


def test_a_letter_that_is_too_large_is_refused(context):
    latest = LatestValue(10, context)
    try:
        with pytest.raises(ValueError, match="11 bytes for a capacity of 10"):
            latest.put(bytes(11))
    finally:
        latest.close()


def test_the_writer_never_waits_for_the_reader(context):
    latest = LatestValue(10, context)
    try:
        latest._lock.acquire()
        assert latest.put(b"x") is False
        assert latest.missed_writes == 1
        latest._lock.release()
        assert latest.put(b"y")
    finally:
        latest.close()


def test_values_cross_to_another_process_in_order_and_the_last_arrives(context):
    latest = LatestValue(100, context)
    ours, theirs = context.Pipe()
    process = context.Process(target=forward_values, args=(latest, theirs))
    process.start()
    try:
        assert ours.poll(60)
        assert ours.recv() == "ready"
        for i in range(1000):
            while not latest.put(b"%05d" % i):
                pass
        while not latest.put(b"end"):
            pass
        process.join(60)
        assert process.exitcode == 0
        has_news, taken = make_poll(ours), []
        while has_news():
            taken.append(ours.recv())
        assert taken[-1] == b"end"
        assert taken == sorted(taken)
    finally:
        process.kill()
        process.join()
        latest.close()
