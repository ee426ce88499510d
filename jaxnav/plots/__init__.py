"""Pictures: of drives, studies, calibrations and tuning, as matplotlib draws them."""
