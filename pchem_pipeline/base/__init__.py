"""The words shared by all rooms: errors with exit codes, stored variables, the base of YAML sections."""
