"""The error a restorer makes: expected, calibrated, and shown."""
