"""A shared value that keeps only the newest, across a process boundary."""

import multiprocessing

import pytest

from vinesim.client.sensing.latest_value import LatestValue, make_poll


def forward_values(latest, pipe):
    """The reader's process: sends "ready", then the values that it takes, until b"end"."""
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


def test_the_newest_value_replaces_an_unread_one(context):
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


def test_a_value_that_is_too_large_is_refused(context):
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


def test_values_arrive_in_another_process_in_order_and_the_last_one_always(context):
    latest = LatestValue(100, context)
    receiver, sender = context.Pipe()
    process = context.Process(target=forward_values, args=(latest, sender))
    process.start()
    try:
        assert receiver.poll(60)
        assert receiver.recv() == "ready"
        for i in range(1000):
            while not latest.put(b"%05d" % i):
                pass
        while not latest.put(b"end"):
            pass
        process.join(60)
        assert process.exitcode == 0
        poll, received = make_poll(receiver), []
        while poll():
            received.append(receiver.recv())
        assert received[-1] == b"end"
        assert received == sorted(received)
    finally:
        process.kill()
        process.join()
        latest.close()
