"""From run folders to tables; the only room of the study that may load torch."""
