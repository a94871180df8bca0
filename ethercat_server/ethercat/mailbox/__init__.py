"""The CoE mailbox of a slave, and what it says there unasked."""
