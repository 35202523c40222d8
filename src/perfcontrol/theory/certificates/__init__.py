"""`pc.certify`: one file a kind of certificate, and what the kinds share."""
