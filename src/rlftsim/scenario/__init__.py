"""What happened: recorded scenarios, however they were stored."""
