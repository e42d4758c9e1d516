"""Define what every other package shares: errors, physical quantities, frames, spectra, tables, pages."""
