"""Networks of experts: from observations to action logits and a value."""
