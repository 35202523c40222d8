"""A report on one problem: what is found out (`findings`), said (`sections`), drawn (`figures`) and put together."""
