"""PI controllers that speak GCS 2.0 (C-863 class)."""

DRIVERS = {"pi_gcs": "PiGcsStage"}
