"""What every room stands on: errors, units, files, rotations, columns of samples, parallel work."""
