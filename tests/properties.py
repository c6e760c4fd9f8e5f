"""How many examples Hypothesis tries: the same few in every run, or TORCHSPLINE_EXAMPLES=5000 random ones."""

import os

from hypothesis import HealthCheck, settings


def examples(count: int) -> settings:
    many = int(os.environ.get("TORCHSPLINE_EXAMPLES", "0"))
    return settings(
        max_examples=many or count,
        derandomize=not many,
        database=None,
        print_blob=True,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],  # a busy machine is no fault
    )
