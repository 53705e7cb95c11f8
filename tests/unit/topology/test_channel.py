"""The radio: bursts, random delays, outages, sending by events, and what is counted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trainctl import draws
from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario
from trainctl.topology import exchange, graph
from trainctl.topology.exchange import Radio, deliver, silent

N = 40
NAMES = np.array([draws.word(str(i)) for i in range(N)])
PLAN = graph.Plan(
    rule="same_track", equal=False, first_slot=0.0, desired=np.full(N - 1, 100.0), lower=np.full(N - 1, 1.0),
    upper=np.full(N - 1, 1e4), weight=1.0, stated={}, extra=(), fixed=(), place=np.arange(N),
)  # fmt: skip
LINKS = graph.links(PLAN, np.arange(N), np.zeros(N, np.int64))


def radio(seed=1, names=NAMES, **more):
    return Radio(**{"loss": 0.0, "delay": 0, "radius": np.inf, "key": np.tile(draws.key(seed), (N, 1)), "names": names, **more})


def over(r, exchanges, links=LINKS, place=lambda k: np.zeros(N), begin=0):
    """Which links heard in each exchange (k, L), what they heard (k, L), and the messages; train i says k in exchange k."""
    messages, heard, said = silent(), [], []
    for k in range(begin, begin + exchanges):
        messages, now = deliver(r, messages, np.full((N, 1), float(k)), np.zeros(N), links, k, float(k), place(k))
        heard.append(now)
        said.append(messages.heard[:, 0].copy())
    return np.array(heard), np.array(said), messages


def lengths(flags):
    """Lengths of the runs of True in each column that begin and end within."""
    found = []
    for column in flags.T:
        edges = np.flatnonzero(np.diff(column.astype(int)))
        starts = edges[column[edges + 1]]
        found += [int(edges[edges > a][0] - a) for a in starts if np.any(edges > a)]
    return np.array(found)


def test_bursts_have_the_stated_lengths_and_losses():
    """Mean good time 20 exchanges, bad time 5, 90 % lost in these and 2 % else."""
    r = radio(turns_bad=1 / 20, turns_good=1 / 5, bad_loss=0.9, loss=0.02)
    messages, bad = silent(), []
    heard = []
    for k in range(3000):
        messages, now = deliver(r, messages, np.zeros((N, 1)), np.zeros(N), LINKS, k, 0.0, np.zeros(N))
        bad.append(messages.bad.astype(bool))
        heard.append(now)
    bad, heard = np.array(bad), np.array(heard)
    assert bad.mean() == pytest.approx(5 / 25, abs=0.01)
    assert lengths(bad).mean() == pytest.approx(5.0, rel=0.05) and lengths(~bad).mean() == pytest.approx(20.0, rel=0.05)
    assert 1.0 - heard[bad].mean() == pytest.approx(0.9, abs=0.01) and 1.0 - heard[~bad].mean() == pytest.approx(0.02, abs=0.003)
    assert bad[0].mean() == pytest.approx(0.2, abs=0.1)  # from the start on


def test_links_have_channels_of_their_own_whoever_else_there_is():
    r = radio(turns_bad=0.1, turns_good=0.2)
    heard, _, _ = over(r, 1500)
    assert (
        np.abs(np.corrcoef(heard.T.astype(float)) - np.eye(heard.shape[1])).max() < 0.3
    )  # 1500 exchanges are some 260 independent ones
    assert np.array_equal(heard, over(r, 1500)[0]) and not np.array_equal(
        heard, over(radio(2, turns_bad=0.1, turns_good=0.2), 1500)[0]
    )
    few = graph.links(PLAN, np.arange(N), (np.arange(N) > 1).astype(np.int64))  # trains 0 and 1 alone, the others among themselves
    alone = over(r, 200, few)[0]
    for k in range(len(few.sender)):
        (row,) = np.flatnonzero((LINKS.sender == few.sender[k]) & (LINKS.receiver == few.receiver[k]))
        np.testing.assert_array_equal(alone[:, k], heard[:200, row])


@pytest.mark.parametrize(("exponential", "mean"), [(False, 2.0), (True, 4.0 * (1.0 - np.exp(-5.0)))])
def test_a_random_delay_is_distributed_as_stated(exponential, mean):
    """Whole exchanges, so half a one more in the mean; 4 exchanges wide or in the mean, on top of one."""
    r = radio(delay=1, spread=4.0, exponential=exponential)
    rows = len(LINKS.sender)
    words, other = NAMES[LINKS.sender], NAMES[LINKS.receiver]
    taken = []
    for k in range(400):
        messages = silent()
        for age in range(r.oldest + 1):
            spoke = np.arange(N) >= 0 if age == 0 else np.zeros(N, bool)
            sent = np.full((N, 1), float(age))
            messages = messages._replace()
            messages, now = deliver(r, messages, sent, np.zeros(N), LINKS, k + age, 0.0, np.zeros(N))
            messages = messages._replace(spoke=(*messages.spoke[:-1], spoke))
            if now.any():
                taken += [age] * int(now.sum())
    assert len(taken) == 400 * rows, (len(words), len(other))
    assert min(taken) == 2 and max(taken) <= r.oldest
    assert np.mean(taken) - 1.0 - 0.5 == pytest.approx(mean, rel=0.03)


def test_a_message_that_is_overtaken_is_of_no_use():
    _, said, _ = over(radio(spread=6.0), 300)
    assert np.all(np.diff(said, axis=0) >= 0.0)
    ages = np.arange(300)[50:, None] - said[50:]
    assert ages.min() >= 0 and ages.max() <= 12 and np.unique(ages).size > 3


def test_in_an_outage_nobody_hears_or_is_heard():
    r = radio(outages=np.array([[3.0, 10.0, 16.0], [-1.0, 30.0, 31.0]]))
    heard, said, messages = over(r, 40)
    of = (LINKS.sender == 3) | (LINKS.receiver == 3)
    assert not heard[10:16, of].any() and heard[10:16, ~of].all()
    assert not heard[30].any() and heard[31:].all() and heard[:10].all()
    assert np.all(said[15, of] == 9.0)
    assert messages.counted.tolist() == [40 * N - 6 - N, int(heard.sum())]


def test_who_sends_by_events_sends_when_it_has_moved_or_after_a_while():
    """Train i moves i tenths of a metre per exchange against the reference: it sends once it is more than 2 m off."""
    heard, said, messages = over(radio(beyond=2.0), 101, place=lambda k: 0.1 * k * np.arange(N))
    of = {i: heard[:, LINKS.sender == i][:, 0] for i in (0, 1, 5, 30)}
    assert of[0].sum() == 1 and of[1].sum() == 1 + 100 // 21 and of[5].sum() == 1 + 100 // 5 and of[30].all()
    assert messages.counted[0] < 101 * N
    forced, _, _ = over(radio(beyond=2.0, silent=10), 101, place=lambda k: np.zeros(N))
    assert np.flatnonzero(forced[:, 0]).tolist() == list(range(0, 101, 10))
    assert np.all(np.diff(said, axis=0) >= 0.0)


def test_a_link_that_stays_keeps_its_channel_when_the_graph_changes():
    r = radio(turns_bad=0.1, turns_good=0.1)
    _, _, messages = over(r, 50)
    few = graph.links(PLAN, np.arange(N), (np.arange(N) > 1).astype(np.int64))
    after = exchange.relinked(messages, LINKS, few)
    for k in range(len(few.sender)):
        (row,) = np.flatnonzero((LINKS.sender == few.sender[k]) & (LINKS.receiver == few.receiver[k]))
        assert after.bad[k] == messages.bad[row] and after.newest[k] == messages.newest[row]


# As scenarios


def test_what_is_sent_and_received_is_counted(finished):
    short = {"run.duration_s": 50, "run.sub_step_s": 0.1}
    run = finished("time_headway", "numeric", **short)
    assert (run.info["messages_sent"], run.info["messages_received"]) == (50 * 6, 50 * 10)
    seldom = finished("time_headway", "numeric", **short, **{"channel.send_beyond_m": 5.0, "channel.send_every_s": 10.0})
    assert 6 * 5 <= seldom.info["messages_sent"] < 150


def test_an_outage_is_an_event(finished):
    event = [{"kind": "outage", "train": "all", "time_s": 10.0, "until_s": 16.0}]
    run = finished("time_headway", "numeric", **{"run.duration_s": 30, "run.sub_step_s": 0.1, "event": event})
    lines = [json.loads(line) for line in (run.folder / "events.jsonl").read_text().splitlines()]
    assert [(e["time_s"], e["kind"], e["train"]) for e in lines if e["kind"].startswith("outage")] == [
        (10.0, "outage", "all"), (16.0, "outage_over", "all"),
    ]  # fmt: skip
    heard = run.links.groupby("time_s")["heard"].all()
    assert not heard.loc[10.0:15.0].any() and heard.loc[16.0:29.0].all() and heard.loc[:9.0].all()


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"channel.good_s": 60.0}, "channel: good_s and bad_s: give both or none"),
        ({"channel.good_s": 60.0, "channel.bad_s": 0.5}, "channel.bad_s = 0.5: must be at least the exchange period of 1 s"),
        ({"channel.bad_loss": 0.5}, "channel: bad_loss = 0.5: only with good_s and bad_s"),
        ({"channel.send_every_s": 5.0}, "channel: send_every_s = 5: only with send_beyond_m"),
        (
            {"channel.send_every_s": 0.2, "channel.send_beyond_m": 1.0},
            "channel.send_every_s = 0.2: must be at least the exchange period of 1 s",
        ),
        ({"event": [{"kind": "outage", "train": "1"}]}, "event[1]: an outage needs until_s"),
        (
            {"event": [{"kind": "outage", "train": "1", "until_s": 5.0, "position_m": 1.0}]},
            "event[1]: position_m: not with kind = outage",
        ),
        ({"event": [{"kind": "brake", "train": "all"}]}, "event[1].train = all: no such train; there are: 1, 2, 3, 4, 5, 6"),
    ],
)
def test_bad_input(keys, line):
    with pytest.raises(InputError) as told:
        open_scenario("time_headway", {"run.seed": 1, **keys})
    assert told.value.mistakes == [f"time_headway.toml: {line}"]


def test_a_random_channel_needs_a_seed():
    with pytest.raises(InputError, match=r"channel.delay_spread_s = 2: the channel is random, so the run needs \[run\] seed"):
        open_scenario("time_headway", {"channel.delay_spread_s": 2.0})


def test_a_law_in_continuous_time_needs_instants_to_exchange_at():
    with pytest.raises(InputError, match=r"topology.communication_period_s: missing; loss, delay and the channel need messages"):
        open_scenario("emu_finite_time", {"channel.good_s": 60.0, "channel.bad_s": 2.0, "run.seed": 1})
