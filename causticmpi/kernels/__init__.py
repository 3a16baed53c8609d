"""Pure compiled code: it knows neither rank, nor file, nor clock."""
