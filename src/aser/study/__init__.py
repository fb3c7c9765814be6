"""From run folders to tables, statistics and pictures. Nothing here trains or imports what trains."""
