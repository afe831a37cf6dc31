"""What runs in the reference's own interpreter, and the plain files that both sides share."""
