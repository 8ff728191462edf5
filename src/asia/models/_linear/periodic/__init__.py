"""Linear systems from the steady-state lines of records with periodic inputs.

Source: McKelvey, Akcay and Ljung, Subspace-based multivariable system identification from
frequency response data, IEEE Trans. Automatic Control 41(7), 1996; Pintelon and Schoukens, System
Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012.
"""
