"""A live stand: sequencing, devices, drivers of tables, nodes, and the page that shows it."""
