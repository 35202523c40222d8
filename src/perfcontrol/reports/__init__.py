"""Claims checked against data, and the tables that say so."""
