"""After reconstruction: enhancement, clusters of grey values, and particles with their sizes."""
