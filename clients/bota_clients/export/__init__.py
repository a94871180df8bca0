"""`ethercat-export`: a recording as a table for pandas, MATLAB and spreadsheets."""
