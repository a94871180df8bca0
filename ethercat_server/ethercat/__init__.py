"""An EtherCAT bus and its slaves; nothing of Bota. Imports only `ethercat_server.errors`."""
