"""What the tests of link files share: a file of each format, and small helpers."""

from pathlib import Path

from bufgym.traces import Trace

UCC_HEADER = "Timestamp,Speed,DL_bitrate,UL_bitrate,State\n"
HEADER = "t_ms,bytes,interval_ms\n"


def written(folder: Path, text: str | bytes, name: str = "lte.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def knots(trace: Trace) -> list[tuple[int, int]]:
    return list(zip(trace.time_us.tolist(), trace.cumulative_bytes.tolist(), strict=True))


SAMPLES = {
    "mahimahi": "0\n2\n2\n3\n10\n",
    "csv": HEADER + "840,1000,840\n1840.5,5000,1000.5\n",
    "mbit": "10 8\n11\t16\n13 0\n14 4\n",
    "belgium": "1453112088291 710 51.04 3.72 994124 710\n1453112089290 1709 51.04 3.72 3324168 999\n",
    "rates": "time_s,bytes_per_s\n10,1000\n12,0\n12.5,4\n",
    "ucc": UCC_HEADER + "2019.12.16_13.40.04,0,72,20,D\n2019.12.16_13.40.05,0,0,8,I\n",
    "nyu": "0.5,Mbits/sec\n0,bits/sec\n43.3,Kbits/sec\n",
    "nuttcp": "nuttcp-r: socket\n 3.1250 MB / 0.50 sec = 52.4288 Mbps 0 retrans\n 0.0000 MB / 1.00 sec = 0.0 Mbps\n",
    "iperf3": '{"intervals":[{"sum":{"start":0,"end":1.5,"bytes":3000}},\n{"sum":{"start":1.5,"end":2,"bytes":7}}]}',
    "runs": "####\nRun 1\n8,16,0\n####\nRun 3\n0.5,1.5\n8,4\n",
    "sabre": '[\n{"duration_ms": 725, "bandwidth_kbps": 36014},\n{"duration_ms": 1000, "bandwidth_kbps": 16}\n]\n',
    "iperf-text": "[ ID] Interval       Transfer     Bandwidth\n[  3]  0.0- 1.0 sec  1.25 MBytes  10.5 Mbits/sec\n"
    "[  3]  1.0- 2.0 sec  128 KBytes  1.05 Mbits/sec\n[  3]  0.0- 2.0 sec  1.38 MBytes  5.77 Mbits/sec\n",
    "mm-link": "# mahimahi mm-link (uplink) [a] > b\n# base timestamp: 3\n3 # 1504\n4 + 1504\n4 - 1504 1\n7 # 1504\n",
    "proc-net-dev": "Inter-|   Receive                |  Transmit\n face |bytes    packets|bytes\n1700000000.5\n"
    "    lo:  1 0 0 0 0 0 0 0 1 0 0 0 0 0 0 0\n wlan0: 500 5 0 0 0 0 0 0 1000 9 0 0 0 0 0 0\n1700000001.5\n"
    " wlan0: 700 5 0 0 0 0 0 0 3000 9 0 0 0 0 0 0\n1700000003.5\n wlan0: 900 5 0 0 0 0 0 0 3500 9 0 0 0 0 0 0\n",
    "mmcli": "bearer.stats.duration : 10\nbearer.stats.bytes-rx : 7\nbearer.stats.bytes-tx : 100\n"
    "bearer.stats.duration : 12\nbearer.stats.bytes-rx : 9\nbearer.stats.bytes-tx : 700\n"
    "bearer.stats.duration : 13\nbearer.stats.bytes-rx : 9\nbearer.stats.bytes-tx : 700\n",
}
