from __future__ import annotations

import numpy as np
import pytest

from trainctl import draws
from trainctl.topology import graph
from trainctl.topology.exchange import Radio, deliver, relinked, silent

IDS = tuple("123456")
NOTHING = graph.Stated(None, None, None, None)


def plan(**more):
    fields = {
        "rule": "same_track", "equal": False, "first_slot": 0.0, "desired": np.full(5, 5000.0), "lower": np.full(5, 100.0),
        "upper": np.full(5, 10000.0), "weight": 1.0, "stated": {}, "extra": (), "fixed": (), "place": np.arange(6),
    }  # fmt: skip
    return graph.Plan(**{**fields, **more})


def made(p, track, position=(24e3, 21e3, 13e3, 12e3, 9e3, 0.0)):
    track, position = np.array(track), np.array(position)
    order = graph.order_on_tracks(position, track)
    return graph.links(p, order, track)


def row(links, sender, receiver):
    (k,) = np.flatnonzero((links.sender == sender - 1) & (links.receiver == receiver - 1))
    return links.desired[k], links.lower[k], links.upper[k]


def test_neighbours_on_one_track_hear_each_other_and_nobody_else():
    links = made(plan(), [1, 1, 1, 1, 2, 1])
    assert graph.edges(links, IDS) == [["1", "2"], ["2", "3"], ["3", "4"], ["4", "6"]]
    assert graph.components(6, links.sender, links.receiver) == [[0, 1, 2, 3, 5], [4]]
    assert links.first.tolist() == [0, 1, 3, 5, 7, 7, 8]


def test_both_directions_of_a_link_are_the_same_numbers_with_the_sign_changed():
    links = made(plan(stated={(0, 1): graph.Stated(4000.0, 50.0, 9000.0, None), (1, 0): graph.Stated(-4000.0, -9000.0, -50.0, None)}),
                 [1, 1, 1, 1, 2, 1])  # fmt: skip
    assert row(links, 1, 2) == (4000.0, 50.0, 9000.0)
    assert row(links, 2, 1) == (-4000.0, -9000.0, -50.0)
    assert row(links, 4, 3) == (-5000.0, -10000.0, -100.0)


def test_where_a_train_left_the_link_spans_its_hole():
    links = made(plan(), [1, 3, 1, 1, 1, 1])
    assert graph.edges(links, IDS) == [["1", "3"], ["3", "4"], ["4", "5"], ["5", "6"]]
    assert row(links, 1, 3) == (10000.0, 200.0, 20000.0)
    assert row(links, 3, 1) == (-10000.0, -20000.0, -200.0)


def test_stated_numbers_of_the_longer_link_come_first():
    stated = {(0, 2): graph.Stated(None, 5100.0, 15000.0, None), (2, 0): graph.Stated(None, -15000.0, -5100.0, None)}
    assert row(made(plan(stated=stated), [1, 3, 1, 1, 1, 1]), 1, 3) == (10000.0, 5100.0, 15000.0)


def test_equal_spacing_closes_the_hole():
    links = made(plan(equal=True), [1, 3, 1, 1, 2, 1])
    assert row(links, 1, 3) == (5000.0, 100.0, 10000.0)
    assert row(links, 3, 1) == (-5000.0, -10000.0, -100.0)


def test_with_equal_spacing_the_slots_are_those_of_each_track():
    links = made(plan(equal=True, first_slot=-100.0), [1, 3, 1, 1, 3, 1])
    np.testing.assert_allclose(links.slot, [-100.0, -100.0, -5100.0, -10100.0, -5100.0, -15100.0])
    np.testing.assert_allclose(links.desired, links.slot[links.sender] - links.slot[links.receiver])
    assert made(plan(), [1, 3, 1, 1, 3, 1]).slot.tolist() == [0.0, -5000.0, -10000.0, -15000.0, -20000.0, -25000.0]


def test_extra_links_exist_only_while_both_are_on_one_track():
    p = plan(extra=((0, 2), (3, 5)))
    assert ["1", "3"] in graph.edges(made(p, [1, 1, 1, 1, 2, 1]), IDS)
    assert ["1", "3"] not in graph.edges(made(p, [3, 1, 1, 1, 2, 1]), IDS)


def test_rule_links_keeps_direction():
    links = made(plan(rule="links", fixed=((0, 1), (1, 2), (2, 0))), [1] * 6)
    assert sorted(zip(links.sender.tolist(), links.receiver.tolist(), strict=True)) == [(0, 1), (1, 2), (2, 0)]
    assert row(links, 3, 1) == (-10000.0, -20000.0, -200.0)


def test_order_notices_an_overtaking_and_a_track_change():
    position, track = np.array([30.0, 20.0, 10.0]), np.array([0, 0, 0])
    order = graph.order_on_tracks(position, track)
    assert graph.in_order(order, position, track)
    assert not graph.in_order(order, np.array([30.0, 20.0, 25.0]), track)
    assert not graph.in_order(order, position, np.array([1, 0, 0]))


def test_senders_ahead_come_first_in_order():
    links = made(plan(), [1, 1, 1, 1, 2, 1])
    rank = {t: k for k, t in enumerate(links.order.tolist())}
    for sender, receiver, desired in zip(links.sender.tolist(), links.receiver.tolist(), links.desired, strict=True):
        if desired > 0:
            assert rank[sender] < rank[receiver]


NAMES = np.array([draws.word(str(i)) for i in range(1, 7)])


def seeded(loss, delay, radius, seed, names):
    return Radio(loss, delay, radius, np.tile(draws.key(seed), (len(names), 1)), names)


def deliveries(radio, links, count):
    """Which links heard in so many exchanges, and the messages after them; train i says k in exchange k."""
    messages, heard, position = silent(), [], np.arange(6.0) * -1000.0
    for k in range(count):
        messages, now = deliver(radio, messages, np.full((6, 1), float(k)), position, links, k, float(k), position)
        heard.append(now)
    return np.array(heard), messages


def test_losses_are_seeded_and_of_the_stated_share():
    links = made(plan(), [1] * 6)
    first, again, other = (deliveries(seeded(0.1, 0, np.inf, seed, NAMES), links, 2000)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert 1 - first.mean() == pytest.approx(0.1, abs=0.01)


def test_losses_belong_to_sender_and_receiver():
    """Trains that come between, or stand in another order, change nobody else's losses; links lose independently."""
    few, many = made(plan(), [1] * 6), made(plan(), [1] * 6)
    turned = NAMES[::-1].copy()
    one, other = (deliveries(seeded(0.3, 0, np.inf, 5, names), links, 2000)[0] for names, links in ((NAMES, few), (turned, many)))
    pair = {(NAMES[s], NAMES[r]): one[:, k] for k, (s, r) in enumerate(zip(few.sender, few.receiver, strict=True))}
    for k, (s, r) in enumerate(zip(many.sender, many.receiver, strict=True)):
        assert np.array_equal(other[:, k], pair[turned[s], turned[r]])
    assert np.abs(np.corrcoef(one.T) - np.eye(one.shape[1])).max() < 0.1


def test_a_lost_message_leaves_the_last_one_in_place():
    links, radio = made(plan(), [1] * 6), seeded(0.5, 0, np.inf, 3, NAMES)
    messages = silent()
    for k in range(50):
        before = messages
        messages, heard = deliver(radio, before, np.full((6, 1), float(k)), np.zeros(6), links, k, 0.0, np.zeros(6))
        assert np.all(messages.heard[heard] == k)
        if k:
            assert np.array_equal(messages.heard[~heard], before.heard[~heard])


def test_an_exchange_leaves_the_messages_before_as_they_were():
    """Whoever tries a step must find them again."""
    links, radio = made(plan(), [1] * 6), seeded(0.5, 1, np.inf, 3, NAMES)
    messages = deliveries(radio, links, 5)[1]
    sent, heard, ever = [s.copy() for s in messages.sent], messages.heard.copy(), messages.ever.copy()
    later, _ = deliver(radio, messages, np.full((6, 1), 9.0), np.zeros(6), links, 5, 0.0, np.zeros(6))
    assert [s.tolist() for s in messages.sent] == [s.tolist() for s in sent]
    assert np.array_equal(messages.heard, heard) and np.array_equal(messages.ever, ever)
    assert not np.array_equal(later.heard, heard)


def test_delay_counts_exchanges():
    links = made(plan(), [1] * 6)
    heard, messages = deliveries(seeded(0.0, 2, np.inf, 0, NAMES), links, 3)
    assert heard.all(axis=1).tolist() == [False, False, True]
    assert np.all(messages.heard == 0.0)
    heard, messages = deliveries(seeded(0.0, 2, np.inf, 0, NAMES), links, 8)
    assert np.all(messages.heard == 5.0) and len(messages.sent) == 3  # what has arrived is not kept


def test_messages_end_at_the_range():
    links = made(plan(), [1] * 6)
    position = np.array([0.0, -1000.0, -3000.0, -4000.0, -5000.0, -6000.0])
    _, heard = deliver(seeded(0.0, 0, 1500.0, 0, NAMES), silent(), np.zeros((6, 1)), position, links, 0, 0.0, position)
    pairs = {frozenset((int(s), int(r))) for s, r, h in zip(links.sender, links.receiver, heard, strict=True) if not h}
    assert pairs == {frozenset((1, 2))}


def test_what_was_heard_stays_with_its_link_when_the_graph_changes():
    before, after = made(plan(), [1, 1, 1, 1, 2, 1]), made(plan(), [1, 3, 1, 1, 1, 1])
    messages, _ = deliver(
        seeded(0.0, 0, np.inf, 0, NAMES), silent(), np.arange(6.0)[:, None], np.zeros(6), before, 0, 0.0, np.zeros(6)
    )
    messages = relinked(messages, before, after)
    heard = {
        (int(s), int(r)): (v, e)
        for s, r, v, e in zip(after.sender, after.receiver, messages.heard[:, 0], messages.ever, strict=True)
    }
    assert heard[2, 3] == (2.0, True)
    assert heard[0, 2][1] == np.False_


def test_a_link_that_has_received_once_stays_one_whatever_is_lost_and_however_the_graph_changes():
    """A train that goes by old messages must not take the zeros of a new link for one."""
    before, after = made(plan(), [1, 1, 1, 1, 2, 1]), made(plan(), [1, 3, 1, 1, 1, 1])
    messages, radio = silent(), seeded(0.5, 0, np.inf, 1, NAMES)
    received, last = np.zeros(len(before.sender), bool), np.zeros(len(before.sender))
    for k in range(1, 3):
        messages, heard = deliver(radio, messages, 10.0 * k + np.arange(6.0)[:, None], np.zeros(6), before, k, 0.0, np.zeros(6))
        received |= heard
        last[heard] = 10.0 * k + before.sender[heard]
        np.testing.assert_array_equal(messages.ever, received)
    assert (received & ~heard).any() and not received.all()  # some were lost again, some never heard
    messages = relinked(messages, before, after)
    old = {(s, r): (e, x) for s, r, e, x in zip(before.sender, before.receiver, received, last, strict=True)}
    kept = [old.get((s, r), (False, 0.0)) for s, r in zip(after.sender, after.receiver, strict=True)]
    assert list(zip(messages.ever.tolist(), messages.heard[:, 0].tolist(), strict=True)) == kept
    assert any(e for e, _ in kept) and not all((s, r) in old for s, r in zip(after.sender, after.receiver, strict=True))
