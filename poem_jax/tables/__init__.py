"""The paper's tables: rows as data, which of them can run here, and their layout beside the paper's."""
