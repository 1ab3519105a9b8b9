"""The paper's studies and vnet's own: many runs, their tables and their pictures. No part of the wheel."""
