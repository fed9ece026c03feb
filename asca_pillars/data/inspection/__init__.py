"""What a dataset contains and how it suits a configuration."""
