"""Which share of each light each sample sees, by traced rays; numpy and Embree's library alone."""
