"""The newest letter only, across a real process boundary."""

import multiprocessing

import pytest

from vinesim.client.sensing.latest_value import LatestValue, poller


def read_all(mailbox, pipe):
    """The reader's process: says that it is there, then what it takes, until an empty letter."""
    pipe.send("ready")
    while True:
        letter = mailbox.take(5.0)
        if letter is not None:
            pipe.send(letter)
            if letter == b"end":
                return


@pytest.fixture
def context():
    return multiprocessing.get_context("spawn")


def test_the_newest_letter_replaces_what_was_not_read(context):
    mailbox = LatestValue(100, context)
    try:
        assert mailbox.take(0.0) is None
        for i in range(5):
            assert mailbox.put(b"letter %d" % i)
        reader = LatestValue.__new__(LatestValue)
        reader.__dict__.update(mailbox.__getstate__())
        assert reader.take(0.0) == b"letter 4"
        assert reader.take(0.0) is None
    finally:
        mailbox.close()


def test_a_letter_that_is_too_large_is_refused(context):
    mailbox = LatestValue(10, context)
    try:
        with pytest.raises(ValueError, match="11 bytes for a mailbox of 10"):
            mailbox.put(bytes(11))
    finally:
        mailbox.close()


def test_the_writer_never_waits_for_the_reader(context):
    mailbox = LatestValue(10, context)
    try:
        mailbox._lock.acquire()
        assert mailbox.put(b"x") is False
        assert mailbox.missed_writes == 1
        mailbox._lock.release()
        assert mailbox.put(b"y")
    finally:
        mailbox.close()


def test_letters_cross_to_another_process_in_order_and_the_last_arrives(context):
    mailbox = LatestValue(100, context)
    ours, theirs = context.Pipe()
    process = context.Process(target=read_all, args=(mailbox, theirs))
    process.start()
    try:
        assert ours.poll(60)
        assert ours.recv() == "ready"
        for i in range(1000):
            while not mailbox.put(b"%05d" % i):
                pass
        while not mailbox.put(b"end"):
            pass
        process.join(60)
        assert process.exitcode == 0
        has_news, taken = poller(ours), []
        while has_news():
            taken.append(ours.recv())
        assert taken[-1] == b"end"
        assert taken == sorted(taken)
    finally:
        process.kill()
        process.join()
        mailbox.close()
