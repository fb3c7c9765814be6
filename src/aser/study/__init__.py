"""From run folders to tables, statistics, pictures and reports. Nothing here trains."""
