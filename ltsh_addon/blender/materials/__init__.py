"""Materials: one walk over nodes (`graph`), one table of BSDF nodes (`bsdfs`), and their readers."""
