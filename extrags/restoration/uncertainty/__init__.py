"""The error a restorer expects of its images: model, calibration, reliability diagram."""
