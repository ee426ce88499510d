"""Draw drives, studies, calibrations and tuning with matplotlib."""
