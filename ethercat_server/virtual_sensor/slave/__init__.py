"""What every slave on the virtual bus has: EEPROM, AL states, mailbox, objects of its PDO mapping."""
