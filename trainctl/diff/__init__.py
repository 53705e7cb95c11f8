"""Comparing runs and logs: what a tolerance is, what a difference is, what a finding is.

**Log.** A stream of rows with the same column names in every format (``sources``). Its time column orders the rows, its keys
distinguish rows of one instant; the first key is the train. The rows of one train (and unit, or receiver) in time are a *curve*.

**Tolerance** (``tolerance``). How far a column may lie from the reference: in value and in time, each the widest of an absolute
number, one relative to the value, and one relative to the range of the reference. Without a tolerance in time a value is compared
with the reference's of the same instant: it differs if ``|b - a| > max(absolute, relative |a|, range (max a - min a))``. With one
it differs if it lies outside the *tube*: the rectangle of both tolerances swept along the reference's curve (``tube``). Texts
differ if they are not the reference's at the instant, or at no instant within the tolerance in time.

**Difference** (``rows``, ``in_time``). A value that differs in this sense: time, train, column, both values, by how much, and the
ends of the tube. Or a row that only one log has: one to which the other has none with the same keys at the same instant (or within
the tolerance in time), or not as often. While the logs stream by, the figures of each train and column are kept (``tally``): how
many values differ, the first and the largest, by what constant the column might be shifted or scaled; and the rows of trains that
differ, up to a limit, as evidence. Memory is that of trains times columns, and of what the tolerances in time span.

**Finding** (``findings``, ``causes``, ``closer``). Differences of one cause: the trains, tables and columns, from when on, by how
much, how many values and rows, the first and the largest. A cause is claimed only if it holds for all of these: a column is shifted
if one constant fits every row since, a train is late if every row of the evidence is the reference's of so long before. Each
difference belongs to exactly one finding; what fits no cause is one finding per column.

``runs.diff`` compares, ``results`` and ``page`` write for CIs and eyes, ``golden`` keeps baselines. The user's page is README.md.
"""
