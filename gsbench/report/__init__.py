"""From records to tables and pictures. Reads records only and works without torch."""
