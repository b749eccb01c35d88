"""What the gate has found out about versions, comparisons of training runs, and the webhook."""
