"""What a fit says of itself in two answers, and what follows from them for whoever reads it."""

import equinox as eqx

# Of the search.
FOUND, NOT_ALONE, NOT_ENDED = "found", "not alone", "not ended"
# Of the model.
EXPLAINS, LEAVES, FAILS = "explains the readings", "leaves a part", "does not explain the readings"
# A cause that explains so much of the squared errors is what to mend first.
MOST = 0.6


class Answer(eqx.Module):
    """A word, and in other words why; printed as `word (reason; reason)`.

    >>> print(Answer("not ended", ("max_steps reached",)))
    not ended (max_steps reached)
    """

    word: str
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.word} ({'; '.join(self.reasons)})" if self.reasons else self.word


class Cause(eqx.Module):
    """What most likely makes the errors of a sensor.

    **Fields:** `name` of the cause; `sensor` whose errors; `share` of their sum of squares that it
    explains, `None` where it was found without them; `words` what was found; `remedy` what to try.

    >>> print(Cause("drag", "Gyro", 0.9, "a torque against the rate", "add a Damping"))
    a torque against the rate (90 % of the squared errors of the Gyro)
    """

    name: str
    sensor: str
    share: float | None
    words: str
    remedy: str

    def __str__(self) -> str:
        if self.share is None:
            return self.words
        return f"{self.words} ({100 * self.share:.0f} % of the squared errors of the {self.sensor})"


def status(search: Answer, model: Answer) -> str:
    """Both answers in one line: `ok` where neither has anything to say.

    >>> status(Answer(FOUND), Answer(EXPLAINS)), status(Answer(FOUND), Answer(LEAVES, ("much",)))
    ('ok', 'search: found; model: leaves a part (much)')
    """
    if search == Answer(FOUND) and model == Answer(EXPLAINS):
        return "ok"
    return f"search: {search}; model: {model}"


def advice(search: Answer, model: Answer, causes: tuple[Cause, ...], kind: str) -> str:
    """What follows: whether the intervals can be trusted, and what to try.

    **Arguments:** the two answers; `causes` of what the model leaves, by sensor; `kind` what the
    covariance rests on, in words.
    """
    remedies = list(dict.fromkeys(cause.remedy for cause in causes))
    tries = f" Try: {'; '.join(remedies)}." if remedies else ""
    if model.word == FAILS:
        tries = tries or (
            " Check units (rad/s, m/s², m, s), signs and order of axes, and what else turns the "
            "body; more starts help only where the motion is right."
        )
        return f"The numbers and intervals say nothing about the body.{tries}"
    if search.word == NOT_ENDED:
        tries = tries or " Try more max_steps, more starts, or a start of your own (initial)."
        return f"The intervals are those of a point on the way and cannot be trusted.{tries}"
    if search.word == NOT_ALONE:
        return (
            "Each interval is that of the best motion alone; fit.starts holds the others. Record "
            f"longer, or turn about two axes in one record.{tries}"
        )
    if model.word == LEAVES and any(c.share is None or c.share > MOST for c in causes):
        return (
            "The intervals cannot be trusted: they take the errors for chance, and most of them "
            f"have one cause.{tries}"
        )
    if model.word == LEAVES:
        allowed = "allow" if kind.startswith("sandwich") else "do not allow"
        return (
            f"The intervals {allowed} for errors of this size that last, whatever their cause; "
            f"what shifts a number all along they do not show.{tries}"
        )
    if search.reasons or model.reasons:
        return f"The intervals can be trusted as far as the remarks go.{tries}"
    return "The intervals can be trusted."
