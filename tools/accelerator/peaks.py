"""What makers state of their devices."""

_BFLOAT16_TFLOPS = {
    "H100 PCIe": 756.0,
    "H100 NVL": 835.0,
    "H100": 989.0,
    "H200": 989.0,
    "A100": 312.0,
    "L40S": 362.0,
    "RTX 4090": 165.0,
}
"""Dense matrix products, NVIDIA's data sheets; the first name that is part of the device's counts."""


def peak_tflops(device: str) -> float | None:
    """Return the stated peak in bfloat16 of a device by its name, TFLOP/s; None = not listed here."""
    return next((peak for name, peak in _BFLOAT16_TFLOPS.items() if name in device), None)
