"""Bundle adjustment with lengths, datum, determinacy and snooping."""
