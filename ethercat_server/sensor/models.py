"""By what a Gen-0 sensor is recognized: vendor, product and name, as in SII and in its objects."""

from typing import Final

VENDOR_ID: Final = 0x0000B07A
PRODUCT_CODE: Final = 1  # all Gen-0 EtherCAT models have product code 1; the name identifies the model
REVISION: Final = 3

# Names, as in SII and in object 0x1008.
MODELS: Final = (
    "BFT-SENS-ECAT-M8",
    "BFT-ROKS-ECAT-M8",
    "BFT-ROKA-ECAT-M8",
    "BFT-MEDS-ECAT-M8",
    "BFT-MEDA-ECAT-M8",
    "BFT-LAXS-ECAT-M8",
    "BFT-MEGS-ECAT-M8",
)
