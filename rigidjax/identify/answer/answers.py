"""Describe the two answers of a fit, and the advice that follows from the two answers.

The first answer says whether the search found the best point, the second one whether the model
explains the readings.
"""

import equinox as eqx

# The answer on the search is one of these words: the search found the best point, or another motion
# fits as well, or the search did not end in a minimum.
FOUND, NOT_ALONE, NOT_ENDED = "found", "not alone", "not ended"
# The answer on the model is one of these words, which say how well the model explains the readings.
EXPLAINS, LEAVES, FAILS = "explains the readings", "leaves a part", "does not explain the readings"

# If the errors are larger than the given noise by more than this factor, sensors cannot have made
# them, so that the intervals cannot be trusted.
FAR = 3.0


class Answer(eqx.Module):
    """Hold one answer of a fit: a `word`, and the `reasons` for this answer in words.

    An answer is printed as `word (reason; reason)`.

    >>> print(Answer("not ended", ("max_steps reached",)))
    not ended (max_steps reached)
    """

    word: str
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.word} ({'; '.join(self.reasons)})" if self.reasons else self.word


class Cause(eqx.Module):
    """Hold the most likely cause of the errors of a sensor.

    A cause is printed as its `words`.

    **Fields:**

    - `name`: a short name of the cause, such as "drag".
    - `sensor`: the class of the sensor that has the errors.
    - `share`: the fraction of the sum of squared errors that the cause explains, 0 to 1. It is 1
      for the cause "misread" (the file was read with a wrong unit, axis or sign), and `None` for a
      cause that is only a guess from the class of the sensor.
    - `words`: the cause in words.
    - `remedy`: what to do about the cause.

    >>> print(Cause("drag", "Gyro", 0.9, "a torque against the rate", "add a Damping"))
    a torque against the rate
    """

    name: str
    sensor: str
    share: float | None
    words: str
    remedy: str

    def __str__(self) -> str:
        return self.words


def joined_status(search: Answer, model: Answer) -> str:
    """Return both answers in one line, or `ok` if all is well and neither has a reason."""
    if search == Answer(FOUND) and model == Answer(EXPLAINS):
        return "ok"
    return f"search: {search}; model: {model}"


def advice(
    search: Answer,
    model: Answer,
    causes: tuple[Cause, ...],
    covariance_kind: str,
    error_ratio: float,
    allowance: str,
) -> str:
    """Return words that say whether the intervals can be trusted, and what to try.

    `error_ratio` is the size of the errors divided by the given noise; `allowance` are sentences on
    the sensor errors that the intervals allow for.
    """
    remedies = list(dict.fromkeys(cause.remedy for cause in causes))
    tries = f" Try: {'; '.join(remedies)}." if remedies else ""
    if model.word == FAILS:
        tries = tries or (
            " Check units (rad/s, m/s², m, s), signs and order of axes, and other torques on the "
            "body; more starts help only if the model is right."
        )
        return f"The numbers and intervals say nothing about the body.{tries}"
    if search.word == NOT_ENDED:
        tries = tries or " Try more max_steps, more starts, or a start of your own (initial)."
        return f"The intervals belong to a point before the minimum and cannot be trusted.{tries}"
    if search.word == NOT_ALONE:
        return (
            "Each interval belongs to the best motion alone; fit.starts holds the others. Record "
            f"longer, or turn about two axes in one record.{tries}"
        )
    if model.word == LEAVES and any(cause.share is not None for cause in causes):
        return (
            "The intervals cannot be trusted: they assume random errors, and one cause makes "
            f"most of these errors.{tries}"
        )
    if error_ratio > FAR:
        return f"The intervals cannot be trusted: the sensors make no errors of this size.{tries}"
    if covariance_kind.startswith("jackknife") and model.word != LEAVES:
        remarks = "; read the remarks, too" if search.reasons or model.reasons else ""
        words = "The intervals allow for errors that differ from stretch to stretch of the windows"
        return f"{words}{remarks}. {allowance}"
    if model.word == LEAVES:
        lasting = (
            "allow" if covariance_kind.startswith(("sandwich", "jackknife")) else "do not allow"
        )
        return f"The intervals {lasting} for autocorrelated errors of this size. {allowance}{tries}"
    if search.reasons or model.reasons:
        return f"The intervals allow for the noise; read the remarks, too. {allowance}{tries}"
    return f"The intervals allow for the noise. {allowance}"
