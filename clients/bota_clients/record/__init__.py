"""`ethercat-record`: writes every frame of a server into recordings."""
