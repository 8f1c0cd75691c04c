"""Constants of the Gaussian distribution that several thresholds share."""

MAD_TO_STD = 1.4826
"""Standard deviation over the median absolute deviation: 1 / 0.6745, its quartile."""

MEDIAN_ERROR = 1.25
"""Standard deviation of a median of n values times the root of n, over theirs: sqrt(pi / 2)."""

FIVE_SIGMA = 5.0
"""Standard deviations; noise exceeds them to either side once in 1.7 million. That a file, a table
or a unit contradicts the data is not to be reported by chance in a laboratory's lifetime."""
