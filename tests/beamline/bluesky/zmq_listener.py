"""A separate program with a 0MQ proxy and a dispatcher; it prints a line for each document it receives."""

import json
import sys
import threading

from bluesky.callbacks.zmq import Proxy, RemoteDispatcher

if __name__ == "__main__":
    proxy = Proxy(sys.argv[1], sys.argv[2])
    threading.Thread(target=proxy.start, daemon=True).start()
    dispatcher = RemoteDispatcher(sys.argv[2])
    dispatcher.subscribe(lambda name, document: print(json.dumps([name, document]), flush=True))
    print("ready", flush=True)
    dispatcher.start()
