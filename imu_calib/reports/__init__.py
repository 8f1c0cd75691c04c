"""Results for people: tables, charts, the report, the certificate."""
