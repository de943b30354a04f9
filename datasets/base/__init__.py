"""Files, locks, process pools and seeded draws that every room uses."""
