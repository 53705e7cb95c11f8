"""Reading what runs write: logs of SUMO's in any format, and (``trainctl.record``) our own run folders.

One reader serves ``trainctl diff`` and ``trainctl metrics``: ``logs.sumo_log(path)`` says what a file is, ``Log.batches()``
streams it.

The table a reader returns
--------------------------
``Log.batches()`` yields pyarrow tables, in the order of the file, and begins anew at every call. However a log was written
(XML, CSV with any separator and any style of header, gzipped or not; Parquet), the same run gives the same rows and columns:

rows
    One per element that stands for something: a vehicle, person or container at an instant (``fcd``, ``emission``), a finished
    trip (``tripinfo``), a step (``summary``), an edge or lane and interval (``edgedata``, ``lanedata``), a conflict (``ssm``);
    statistics are a single row. A step without vehicles has no row. CSV and Parquet repeat a row for every element inside it: it
    is one row here.
columns
    Named as SUMO's XML names the attribute (``speed``, ``lane``). What stands inside a row carries the name of its element
    (``emissions_CO_abs``); the second such element of a row a number at the end (``stop_lane2``). What stands around a row becomes
    a column of it: ``time``, or ``begin, end, interval_id`` and, around lanes, ``edge_id``. A column may be missing from a batch
    where it holds nothing.
types
    XML and CSV: texts, as they are written, so that decimals need not be guessed; ``numbers`` makes them float64. Parquet: float32
    and float64, integers, texts, as stored (truth values as texts, dictionaries unpacked). Null where nothing stands, and nothing
    but an empty text. A human-readable time (``1:00:00:02.50``) is a text in seconds (``86402.50``).
batches
    At most some ten thousand rows, or what fits in a few MB of the file; a batch may end within an instant. Memory does not grow
    with the file, but for what has no times: that must be held by who compares it.

Where the work is done: ``kinds`` (what SUMO writes), ``sumo_logs`` (bytes and elements), ``xml_rows`` (the strict parser),
``regular`` (XML exactly as SUMO writes it, several times faster), ``tables`` (CSV and Parquet), ``logs`` (all together).
"""
