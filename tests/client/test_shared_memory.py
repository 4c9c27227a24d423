"""Shared arrays, snapshots and queues, across a real process boundary."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest

from tests.support.waiting import deadline
from vinesim.client.processes.shared_memory import SharedArrays, SharedQueue, SharedSnapshot

RECORD = np.dtype([("number", "i8"), ("values", "f8", (5,))])
LAYOUT = {"number": ((1,), "i8"), "values": ((1000,), "f8")}


@pytest.fixture
def context():
    return multiprocessing.get_context("spawn")


def forward_records(queue, pipe):
    """The reader's process: reports that it is there, then every number that it takes, until a negative one."""
    pipe.send("ready")
    numbers = []
    while not numbers or numbers[-1] >= 0:
        if (record := queue.take(5.0)) is not None:
            assert (record["values"] == record["number"]).all()
            numbers.append(int(record["number"]))
    pipe.send(numbers)


def forward_snapshots(snapshot, pipe):
    """The same for snapshots; each must be of one piece."""
    pipe.send("ready")
    numbers = []
    while not numbers or numbers[-1] >= 0:
        if snapshot.wait(deadline(5.0)):
            with snapshot.reading() as arrays:
                number = int(arrays["number"][0])
                values = arrays["values"].copy()
            assert (values == number).all()
            numbers.append(number)
    pipe.send(numbers)


def read_in_another_process(context, target, shared, write):
    """What ``target`` reports after ``write()``."""
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(shared, theirs))
    process.start()
    try:
        assert ours.poll(60)
        assert ours.recv() == "ready"
        write()
        assert ours.poll(60)
        return ours.recv()
    finally:
        process.kill()
        process.join()
        shared.close()


def test_a_queue_loses_nothing_but_what_it_counts(context):
    queue = SharedQueue(RECORD, 8, context)
    sent = []

    def put(number: int) -> bool:
        with queue.put() as record:
            if record is not None:
                record["number"], record["values"] = number, number
        queue.wake()
        return record is not None

    def write() -> None:
        sent.extend(number for number in range(5000) if put(number))
        while not put(-1):
            queue.lost -= 1  # this one is tried again

    received = read_in_another_process(context, forward_records, queue, write)
    assert received == [*sent, -1]
    assert queue.lost == 5000 - len(sent)


def test_a_full_queue_never_waits_and_a_failed_record_takes_no_room(context):
    queue = SharedQueue(RECORD, 2, context)
    with pytest.raises(ZeroDivisionError), queue.put():
        raise ZeroDivisionError
    for _ in range(3):
        with queue.put() as record:
            pass
    assert record is None
    assert queue.lost == 1
    assert queue.waiting_count == queue.capacity == 2
    queue.wake()
    assert queue.take(0.0) is not None
    assert queue.waiting_count == 1
    queue.close()


def test_a_reader_is_woken_when_the_writer_says_so(context):
    """Not in the middle of a step: several records and the newest snapshot are there at once."""
    queue = SharedQueue(RECORD, 4, context)
    snapshot = SharedSnapshot(LAYOUT, context)
    for number in range(2):
        with queue.put() as record, snapshot.writing() as arrays:
            record["number"] = arrays["number"][0] = number
    assert queue.take(0.0) is None
    assert not snapshot.wait(0.0)
    queue.wake()
    snapshot.wake()
    assert queue._filled.acquire(block=False)
    assert queue._filled.acquire(block=False)
    assert not queue._filled.acquire(block=False)
    assert snapshot.wait(0.0)
    assert not snapshot.wait(0.0)
    queue.close()
    snapshot.close()


def test_snapshots_are_of_one_piece_and_the_last_arrives(context):
    snapshot = SharedSnapshot(LAYOUT, context)

    def put(number: int) -> bool:
        with snapshot.writing() as arrays:
            if arrays is not None:
                arrays["number"][0] = number
                arrays["values"][:] = number
        snapshot.wake()
        return arrays is not None

    def write() -> None:
        for number in range(2000):
            put(number)
        while not put(-1):
            pass

    received = read_in_another_process(context, forward_snapshots, snapshot, write)
    assert received[-1] == -1
    # in order; one may come twice, if it was read between its end and its signal
    assert received[:-1] == sorted(received[:-1])


def test_the_writer_of_a_snapshot_never_waits_for_the_reader(context):
    snapshot = SharedSnapshot(LAYOUT, context)
    assert not snapshot.wait(0.0)
    with snapshot.reading(), snapshot.writing() as arrays:
        assert arrays is None
    assert snapshot.missed_writes == 1
    with snapshot.writing() as arrays:
        assert arrays is not None
    snapshot.wake()
    assert snapshot.wait(0.0)
    assert not snapshot.wait(0.0)
    snapshot.close()


def test_arrays_are_aligned_and_hold_what_was_written():
    arrays = SharedArrays({"flags": ((3,), "?"), "poses": ((4, 7), "f8"), "none": ((0, 7), "f4")})
    arrays["poses"][:] = 1.5
    assert not arrays["flags"].any()
    assert arrays["poses"].ctypes.data % 64 == 0
    assert arrays["none"].shape == (0, 7)
    arrays.close()
    arrays.close()
