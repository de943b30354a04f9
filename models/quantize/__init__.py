"""Vector quantizers (EMA codebooks, residual levels)."""
