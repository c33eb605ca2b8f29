"""What makers state of their devices."""

_TFLOPS = {
    "H100 PCIe": (756.0, 51.0),
    "H100 NVL": (835.0, 60.0),
    "H100": (989.0, 67.0),
    "H200 NVL": (835.0, 60.0),
    "H200": (989.0, 67.0),
    "A100": (312.0, 19.5),
    "L40S": (362.0, 91.6),
    "RTX 4090": (165.0, 82.6),
}
"""In bfloat16 (tensor cores, dense) and in float32 (not TF32), NVIDIA's data sheets; the first name that is
part of the device's counts."""


def peak_tflops(device: str) -> dict[str, float | None]:
    """Return the stated peak of a device by its name, TFLOP/s in `bfloat16` and `float32`; None = not listed
    here."""
    half, full = next((peaks for name, peaks in _TFLOPS.items() if name in device), (None, None))
    return {"bfloat16": half, "float32": full}
