"""What every room stands on: errors, files, locks, sizes, processes and plots."""
