"""What a master knows of one slave: registers, AL states, SII (EEPROM), CoE mailbox."""
