"""Messages: conversion of values, packages built from definitions, serialised transforms."""
