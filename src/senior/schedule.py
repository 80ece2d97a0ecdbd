"""What is due at each step of a run: pure arithmetic on the configuration, so that it can be tried without physics.

A step is the number of environment steps taken before the action of that step. Pre-training ends at step
``until``: the first session takes place there, the critics are renewed and 100 updates follow instead of that
step's own. After the budget is spent, outer steps stop (unless ``after_budget``); the bonus goes on.
"""

from __future__ import annotations

from typing import NamedTuple

from senior.config import Config


class Due(NamedTuple):
    """What happens at one step, in this order, between choosing an action and storing what it did."""

    random: bool  # the action is uniformly random
    session: int  # pairs to ask; 0: no session
    outer: bool
    refresh: bool
    begin: bool  # renew the critics and make the first updates
    pretrain: bool  # an update on state entropy
    update: bool  # an ordinary update

    @property
    def rare(self) -> bool:
        """Whether more than an update is due."""
        return bool(self.session) or self.outer or self.refresh or self.begin


def due(config: Config, step: int, queried: int, session_open: bool = False) -> Due:
    """What is due at ``step`` for a run that has asked ``queried`` pairs.

    A session that was put off for lack of episodes is due again K steps later, as is one that would begin while an
    earlier one is open.
    """
    until, random_steps = config.pretraining.until, config.pretraining.random_steps
    random = step < random_steps
    if not config.method.learns_reward:
        return Due(random, 0, False, False, False, False, update=step > random_steps)
    if step < until:
        return Due(random, 0, False, False, False, pretrain=step > random_steps, update=False)
    queries = config.queries
    left = queries.budget - queried
    on_time = step == until or (step - until) % queries.every == 0
    session = min(queries.per_session, left) if on_time and left > 0 and not session_open else 0
    budget_left = left - session > 0
    outer = (
        config.method.outer == "bilevel"
        and step > until
        and step % config.bilevel.every == 0
        and (budget_left or config.bilevel.after_budget)
    )
    return Due(
        random=False,
        session=session,
        outer=outer,
        refresh=config.method.refreshes
        and (step == until or step % config.pge.every == 0)
        and (config.pge.refresh_with_outer or not outer),
        begin=step == until,
        pretrain=False,
        update=step > until,
    )


class Counts(NamedTuple):
    """What a whole run amounts to."""

    sessions: int
    queried: int
    last_session: int  # step
    outer_steps: int
    refreshes: int
    pretraining_updates: int
    updates: int  # the ones right after pre-training included


def plan(config: Config) -> Counts:
    """Count a run without physics, assuming that every session finds its episodes.

    Only the steps at which something rare can be due are looked at; the others are counted.
    """
    last, until, random_steps = config.steps, config.pretraining.until, config.pretraining.random_steps
    if not config.method.learns_reward:
        return Counts(0, 0, 0, 0, 0, 0, max(0, last - random_steps - 1) * config.sac.updates)
    sessions = queried = last_session = outer = refreshes = begun = 0
    steps = set(range(until, last, config.queries.every))
    for every in (config.pge.every, config.bilevel.every):
        steps |= set(range(-(-until // every) * every, last, every))
    for step in sorted(steps):
        now = due(config, step, queried)
        if now.session:
            sessions, queried, last_session = sessions + 1, queried + now.session, step
        outer += now.outer
        refreshes += now.refresh
        begun += now.begin
    return Counts(
        sessions,
        queried,
        last_session,
        outer,
        refreshes,
        pretraining_updates=max(0, min(until, last) - random_steps - 1) * config.pretraining.updates,
        updates=max(0, last - until - 1) * config.sac.updates + begun * config.sac.reset_updates,
    )
