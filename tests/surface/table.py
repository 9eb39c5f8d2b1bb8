"""All rows: importing this fills the table."""

from surface import (
    calls_brightness as calls_brightness,
    calls_driven as calls_driven,
    calls_events as calls_events,
    calls_filters as calls_filters,
    calls_identify as calls_identify,
    calls_motion as calls_motion,
    calls_numbers as calls_numbers,
    calls_suspensions as calls_suspensions,
)
