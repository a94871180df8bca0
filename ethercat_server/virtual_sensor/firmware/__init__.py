"""Firmware behind the slave controller: AL states, mailbox, object dictionary."""
