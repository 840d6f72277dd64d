"""Links and slots by themselves: when a delay hands on, what a copy converts, what is kept."""

import numpy as np
import pytest

from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.memory.links import CopyMessage, CopySignal, DelayLine, default_slot
from terrafix.cosim.memory.messages import MessageReader, MessageSlot, MessageWriter
from terrafix.cosim.memory.slots import SharedSlot, SignalSlot, WindowView

ONE = {"": Field()}
BOTH = np.ones(2, dtype=bool)


def writer(fields=ONE, n_members=2, active=BOTH):
    return MessageWriter("note", fields, n_members, active)


def seen(line, tick):
    line(tick)
    return line.target.data[:, 0].tolist()


def test_a_delayed_signal_holds_its_first_value_until_the_delay_has_passed():
    """Delay of 3 ticks: the value of tick k is there from tick k + 3 on, that of 0 before."""
    source = SignalSlot(ONE, 1)
    line = DelayLine(source, SignalSlot(ONE, 1), None, 3)
    for tick in range(8):
        source.data[:] = 10.0 + tick
        line.collect(tick)
        assert seen(line, tick) == [10.0 + max(tick - 3, 0)]


def test_a_delay_hands_on_the_latest_of_all_that_is_due_converted_once():
    source = SignalSlot(ONE, 1)
    line = DelayLine(source, SignalSlot(ONE, 1), np.array([1000.0]), 2)
    for tick in range(4):
        source.data[:] = tick
        line.collect(tick)
    assert seen(line, 4) == [2000.0]
    assert seen(line, 4) == [2000.0]
    assert seen(line, 5) == [3000.0]


def test_a_delayed_message_has_not_arrived_at_t_zero():
    """Published at tick 0 with a delay of 2: nothing at 0 and 1, and at 2 as it was published."""
    send, arrived = writer(), []
    line = DelayLine(
        send.slot, MessageSlot(ONE, 2), np.array([0.5]), 2, lambda s: arrived.append(s.data.copy())
    )
    send.publish(0.0, 8.0, valid=np.array([True, False]))
    line.collect(0)
    line.collect(0)  # not published again: not handed on again
    for tick in (0, 1):
        assert np.isnan(seen(line, tick)).all()
        assert line.target.sequence.tolist() == [0, 0]
    assert seen(line, 2)[0] == 4.0
    assert line.target.sequence.tolist() == [1, 0]
    assert line.target.t[0] == 0.0
    assert len(arrived) == 1


def test_a_delay_goes_on_from_its_state():
    """Three values on their way; a line made anew hands on the same at the same ticks."""

    def line(source):
        return DelayLine(source, SignalSlot(ONE, 1), None, 3)

    source = SignalSlot(ONE, 1)
    first, second = line(source), line(source)
    for tick in range(3):
        source.data[:] = 10.0 + tick
        first.collect(tick)
    second.set_state(first.get_state())
    source.data[:] = 13.0
    second.collect(3)  # not the first value: due at 6, not at once
    assert seen(second, 3) == [10.0]
    assert [seen(second, tick) for tick in (4, 5, 6)] == [[11.0], [12.0], [13.0]]


def test_a_delay_of_messages_does_not_take_a_message_twice_after_a_restart():
    send = writer()
    first, second = (DelayLine(send.slot, MessageSlot(ONE, 2), None, 2) for _ in range(2))
    send.publish(0.0, 1.0)
    first.collect(0)
    second.set_state(first.get_state())
    second.collect(1)
    assert second.get_state()["ticks"] == [2]


def test_copies_multiply_by_the_factor_of_each_element():
    fields = {"r": Field((2,)), "age": Field()}
    source, target = SignalSlot(fields, 1), SignalSlot(fields, 1)
    source.data[:] = [1.0, 2.0, 3.0]
    CopySignal(source, target, np.array([10.0, 100.0, 0.5]))(0)
    assert target.views["r"].tolist() == [[10, 200]]
    assert target.views["age"].tolist() == [1.5]


def test_a_copied_message_keeps_time_number_and_count():
    fields = {"": Field((3,), ragged=True)}
    send, target = writer(fields), MessageSlot(fields, 2)
    send.publish(0.5, np.full((2, 3), 2.0), count=[1, 3])
    send.publish(1.5, np.full((2, 3), 4.0), count=2, valid=np.array([False, True]))
    CopyMessage(send.slot, target, np.full(3, 0.25))(0)
    assert target.data.tolist() == [[0.5] * 3, [1.0] * 3]
    assert target.t.tolist() == [0.5, 1.5]
    assert target.sequence.tolist() == [1, 2]
    assert target.count.tolist() == [1, 2]
    assert target.version == send.slot.version == 2


def test_a_message_slot_is_put_back_with_its_count():
    fields = {"": Field((3,), ragged=True)}
    send, other = writer(fields), MessageSlot(fields, 2)
    send.publish(0.5, np.full((2, 3), 2.0), count=[1, 3])
    other.set_state(send.slot.get_state())
    assert other.count.tolist() == [1, 3]
    assert other.sequence.tolist() == [1, 1]
    with pytest.raises(CheckpointError, match=r"has shape \(2, 3\), expected \(1, 3\)"):
        MessageSlot(fields, 1).set_state(send.slot.get_state())


@pytest.mark.parametrize("count", [-1, 4])
def test_a_count_lies_between_nothing_and_the_capacity_for_who_gets_the_message(count):
    send = writer({"": Field((3,), ragged=True)})
    with pytest.raises(ValueError, match=f"holds up to 3, its count is {count}"):
        send.publish(0.0, 0.0, count=[count, 0])
    send.publish(0.0, 0.0, count=[count, 3], valid=np.array([False, True]))
    assert send.slot.count.tolist() == [0, 3]
    with pytest.raises(ValueError, match="is ragged; give its count"):
        send.publish(0.0, 0.0)


def test_a_field_that_is_none_is_missing():
    send = writer({"a": Field(), "b": Field()})
    with pytest.raises(ValueError, match=r"missing \['b'\], unknown \[\]"):
        send.publish(0.0, a=1.0, b=None)


def test_drafts_reach_active_members_alone():
    send = writer(active=np.array([True, False]))
    send.draft[""][:] = 7.0
    send.publish_draft(1.0, BOTH)
    assert send.slot.sequence.tolist() == [1, 0]
    assert send.slot.version == 1


def test_what_is_fresh_and_what_is_lost_is_counted_per_member():
    """Three messages, of which the second member got one: two lost by the first alone."""
    send = writer()
    reader = MessageReader(send.slot)
    for tick in range(3):
        send.publish(float(tick), 1.0, valid=np.array([True, tick == 1]))
    reader.refresh(3)
    assert reader.fresh.tolist() == [True, True]
    assert reader.fresh_number.tolist() == [1.0, 1.0]
    assert reader.overruns == 2
    reader.refresh(4)
    assert reader.fresh_number.tolist() == [0.0, 0.0]
    again = MessageReader(send.slot)
    send.publish(4.0, 1.0, valid=np.array([True, False]))
    reader.refresh(5)
    again.set_state(reader.get_state())
    assert again.fresh.tolist() == [True, False]
    assert again.fresh_number.tolist() == [1.0, 0.0]
    assert again.overruns == 2
    again.refresh(6)  # read before it was saved
    assert again.fresh_number.tolist() == [0.0, 0.0]


def test_a_queue_is_put_back_with_what_waits_in_it():
    """Released for the next step and waiting after it; of two members, each its own."""
    send = writer()
    reader, again = (MessageReader(send.slot, depth=3) for _ in range(2))
    send.publish(0.0, 1.0)
    reader.collect(send.slot)
    reader.release()
    send.publish(1.0, 2.0, valid=np.array([False, True]))
    reader.collect(send.slot)
    again.set_state(reader.get_state())
    again.collect(send.slot)  # nothing new
    again.refresh(2)
    assert [(q["t"].tolist(), q["valid"].tolist()) for q in again.queued] == [([0, 0], [True] * 2)]
    again.release()
    send.publish(2.0, 3.0, valid=np.array([True, False]))
    again.collect(send.slot)
    again.refresh(3)
    assert [q["valid"].tolist() for q in again.queued] == [[False, True]]
    again.refresh(4)
    assert again.queued == []


def test_a_window_grows_by_what_it_holds_and_is_put_back():
    source = np.zeros((1, 2))
    window = WindowView(source, 1, np.array([1000.0, 0.5]))
    for k in range(5):
        source[:] = k
        window.collect(0.25 * k)
    expected = [[[1000.0 * k, 0.5 * k] for k in range(5)]]
    assert window.samples.tolist() == expected
    again = WindowView(source, 1, None)
    again.set_state(window.get_state())
    assert again.samples.tolist() == expected
    assert again.times.tolist() == [0, 0.25, 0.5, 0.75, 1]


def test_a_shared_value_fits_and_cannot_be_written():
    slot = SharedSlot(Field((None, 2)), "image")
    for wrong in (np.zeros((3, 3)), np.zeros(2), np.zeros((3, 2), dtype=np.float32)):
        with pytest.raises(ValueError, match=r"takes shape \(None, 2\) of float64"):
            slot.put(wrong)
    slot.put(np.ones((3, 2)))
    assert not slot.value.flags.writeable
    other = SharedSlot(Field((None, 2)), "image")
    other.set_state(slot.get_state())
    assert other.version == 1
    assert other.value.tolist() == [[1, 1]] * 3


def test_nothing_is_written_until_a_number_is():
    slot = SignalSlot({"a": Field((2,)), "b": Field()}, 2)
    assert slot.never_written
    assert np.isnan(slot.data).all()
    slot.views["b"][1] = np.nan  # a NaN of one's own
    assert not slot.never_written


def test_an_unconnected_bundle_reads_a_default_by_field():
    slot = default_slot({"r": Field((2,)), "age": Field()}, 3, {"r": [1.0, 2.0]})
    assert slot.views["r"].tolist() == [[1, 2]] * 3
    assert slot.views["age"].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"unit": ("m",)}, r"1 units for shape \(2, 3\)"),
        ({"unit": ("m",) * 4}, r"4 units for shape \(2, 3\)"),
        ({"unit": ("m",) * 2}, r"2 units for shape \(2, 3\)"),  # of the first axis
        ({"labels": ("x",) * 2}, r"2 labels for shape \(2, 3\)"),
        ({"labels": ("x",) * 4}, r"4 labels for shape \(2, 3\)"),
    ],
)
def test_units_and_labels_are_those_of_the_last_axis(options, text):
    with pytest.raises(ConfigurationError, match=text):
        Field((2, 3), **options)
    assert Field((2, 3), ("m", "m", "s"), labels=tuple("xyz")).size == 6
