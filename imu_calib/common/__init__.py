"""What every room stands on: errors, units, files, rotations, columns, parallel work."""
