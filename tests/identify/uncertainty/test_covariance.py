"""What the covariance of a fit is made of."""

import numpy as np
import pytest

from rigidjax.identify.uncertainty.covariance import _autocorrelation


@pytest.mark.parametrize("outside", [0.0, 3.0, -1e3])
def test_errors_outside_of_the_mask_do_not_count(outside):
    rng = np.random.default_rng(5)
    errors = np.zeros((2, 400))
    for i in range(1, 400):
        errors[:, i] = 0.7 * errors[:, i - 1] + rng.normal(size=2)
    alone = _autocorrelation(errors[:, :300], np.ones((2, 300), bool))
    mask = np.arange(400) < np.array([[300], [300]])
    assert _autocorrelation(np.where(mask, errors, outside), mask) == pytest.approx(alone)
    # Of an autoregression of the first order: (1 + a) / (1 − a), here 5.7, and a.
    assert 4.0 < alone[0] < 8.0 and abs(alone[1] - 0.7) < 0.08
