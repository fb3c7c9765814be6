"""Settings: Hydra's mapping becomes frozen dataclasses, or one clear line says what is wrong."""
