"""PI controllers with the command language GCS 2.0 (C-863 class)."""

DRIVERS = {"pi_gcs": "PiGcsStage"}
