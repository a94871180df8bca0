"""Slaves of other vendors on the virtual bus, and chains as other masters leave them."""
